//! `loops.csv`: every place that a keyframe was compared with, and the numbers that decided.

use super::OutputError;
use super::number::Measured;
use super::sink::TextSink;
use kilogs_core::loop_closure::{JudgedCandidate, KeyframeOutcome, LoopDecision};
use kilogs_core::places::LoopVerdict;
use std::path::Path;

const COLUMNS: &str = "frame,keyframe,candidate,decision,score,in_a_row,n_matches,n_epipolar,n_inliers,spread,disagreement_deg,\
     scale,distance_m,squared_sigmas,added_cost";

/// A keyframe that was compared with nothing has one row, with this decision.
const NO_CANDIDATE: &str = "no_candidate,,,,,,,,,,,";

/// The table of a run. Frames are those of `frames.csv`, keyframes those of the map.
#[derive(Debug)]
pub struct LoopTable {
    csv: TextSink,
}

impl LoopTable {
    /// Makes the file in the output folder, replacing one that is there.
    ///
    /// # Errors
    /// [`OutputError`] when it cannot be made.
    pub fn create(dir: &Path) -> Result<Self, OutputError> {
        let mut csv = TextSink::create(dir.join("loops.csv"))?;
        csv.write(format_args!("{COLUMNS}\n"))?;
        Ok(Self { csv })
    }

    /// Writes what became of a keyframe.
    ///
    /// # Errors
    /// [`OutputError`] when the disk does not take it.
    pub fn keyframe(
        &mut self,
        frame_index: u64,
        keyframe_id: u32,
        outcome: &KeyframeOutcome,
    ) -> Result<(), OutputError> {
        if outcome.candidates.is_empty() {
            return self.csv.write(format_args!("{frame_index},{keyframe_id},,{NO_CANDIDATE}\n"));
        }
        outcome.candidates.iter().try_for_each(|judged| self.candidate(frame_index, keyframe_id, judged))
    }

    fn candidate(&mut self, frame_index: u64, keyframe_id: u32, judged: &JudgedCandidate) -> Result<(), OutputError> {
        let found = &judged.candidate;
        let (old, decision, n_in_a_row) = (found.ordinal, decision_name(judged), found.n_consecutive);
        self.csv.write(format_args!(
            "{frame_index},{keyframe_id},{old},{decision},{},{n_in_a_row}",
            Measured(found.score)
        ))?;
        match &judged.evidence {
            Some(evidence) => self.csv.write(format_args!(
                ",{},{},{},{},{},{},{}",
                evidence.n_matches,
                evidence.n_epipolar,
                evidence.n_inliers,
                Measured(evidence.spread as f32),
                Measured(evidence.disagreement_rad.to_degrees() as f32),
                Measured(evidence.scale as f32),
                Measured(evidence.distance_m as f32),
            ))?,
            None => self.csv.write(format_args!(",,,,,,,"))?,
        }
        let [squared_sigmas, added_cost] = [judged.squared_sigmas, judged.added_cost].map(|x| Measured(x as f32));
        self.csv.write(format_args!(",{squared_sigmas},{added_cost}\n"))
    }

    /// Hands everything to the system.
    ///
    /// # Errors
    /// [`OutputError`] when the disk does not take it.
    pub fn finish(self) -> Result<(), OutputError> {
        self.csv.finish()
    }
}

/// The decision, by the bar of verification that was not taken where there is one.
fn decision_name(judged: &JudgedCandidate) -> &'static str {
    match judged.decision {
        LoopDecision::Accepted => "accepted",
        LoopDecision::NotConsistent => "not_consistent",
        LoopDecision::TooSoon => "too_soon",
        LoopDecision::AnotherAccepted => "another_accepted",
        LoopDecision::Forgotten => "forgotten",
        LoopDecision::NotVerified => judged.evidence.map_or("not_verified", |evidence| verdict_name(evidence.verdict)),
        LoopDecision::Degenerate => "degenerate",
        LoopDecision::NotPushed(_) => "graph_full",
        LoopDecision::NotSolved(_) => "solver_full",
        LoopDecision::Contradicted => "contradicted",
        LoopDecision::TooFarOff => "too_far_off",
    }
}

fn verdict_name(verdict: LoopVerdict) -> &'static str {
    match verdict {
        LoopVerdict::Accepted => "verified",
        LoopVerdict::TooFewMatches => "too_few_matches",
        LoopVerdict::TooFewEpipolar => "too_few_epipolar",
        LoopVerdict::TooFewInliers => "too_few_inliers",
        LoopVerdict::OnePatch => "one_patch",
        LoopVerdict::SolversDisagree => "solvers_disagree",
        LoopVerdict::ScaleOff => "scale_off",
        LoopVerdict::TooFarApart => "too_far_apart",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use kilogs_core::places::{LoopEvidence, PlaceCandidate, Remembered};

    /// The row of a keyframe with one candidate, or with none, cell by cell under its heading.
    fn row(judged: Option<JudgedCandidate>) -> Vec<(String, String)> {
        let dir = tempfile::tempdir().expect("a folder");
        let mut table = LoopTable::create(dir.path()).expect("a table");
        let candidates = judged.into_iter().collect();
        let outcome = KeyframeOutcome { remembered: Remembered::Added, candidates, optimized: None };
        table.keyframe(40, 7, &outcome).and_then(|()| table.finish()).expect("written");
        let csv = std::fs::read_to_string(dir.path().join("loops.csv")).expect("the table");
        let mut lines = csv.lines().map(|line| line.split(',').map(str::to_owned).collect::<Vec<_>>());
        let (names, cells) = (lines.next().expect("a heading"), lines.next().expect("a row"));
        assert_eq!(names.len(), cells.len(), "{csv}");
        names.into_iter().zip(cells).collect()
    }

    #[test]
    fn each_candidate_has_a_cell_for_each_column_and_says_which_bar_decided() {
        let candidate = PlaceCandidate { ordinal: 3, score: 0.125, n_consecutive: 4, ..PlaceCandidate::default() };
        let evidence = LoopEvidence {
            verdict: LoopVerdict::OnePatch,
            n_matches: 60,
            n_epipolar: 50,
            n_inliers: 40,
            spread: 0.07,
            disagreement_rad: f64::NAN,
            scale: 1.0,
            distance_m: 2.0,
        };
        let judged = |decision, evidence| JudgedCandidate {
            candidate,
            decision,
            evidence,
            squared_sigmas: f64::NAN,
            added_cost: 1.5,
        };
        let check = |judged: Option<JudgedCandidate>, expected: &[(&str, &str)]| {
            let found = row(judged);
            for (name, cell) in expected {
                assert!(found.contains(&((*name).to_owned(), (*cell).to_owned())), "{name} is {cell} in {found:?}");
            }
        };
        check(None, &[("frame", "40"), ("keyframe", "7"), ("candidate", ""), ("decision", "no_candidate")]);
        let refused = judged(LoopDecision::NotVerified, Some(evidence));
        check(
            Some(refused),
            &[("candidate", "3"), ("decision", "one_patch"), ("n_inliers", "40"), ("spread", "0.070")],
        );
        check(Some(refused), &[("disagreement_deg", ""), ("squared_sigmas", ""), ("added_cost", "1.500")]);
        check(Some(judged(LoopDecision::TooSoon, None)), &[("decision", "too_soon"), ("in_a_row", "4"), ("scale", "")]);
    }
}
