//! Loops that a run closed against where the vehicle truly was.

use crate::sequences::table::Table;
use crate::step::StepFailed;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// A place is visited again when an older keyframe stood so near, m, and looked the same way, cosine of 29 degrees.
const REVISIT_M: f64 = 5.0;
const REVISIT_COSINE: f64 = 0.875;
/// An older keyframe is at least this many keyframes older, as in recognition.
const MIN_GAP_KEYFRAMES: usize = 50;
/// A loop is wrong when its cameras were farther apart, m.
const RIGHT_M: f64 = 15.0;
/// A revisit counts as found when a loop was closed within so many metres of way.
pub(super) const FOUND_M: f64 = 10.0;
/// Revisits with fewer metres of way between them are one street.
const SAME_STREET_M: f64 = 20.0;

/// Where a camera truly was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TruePose {
    position_m: [f64; 3],
    forward: [f64; 3],
}

impl TruePose {
    /// Poses of a file in KITTI's format, one per frame.
    pub fn read(path: &Path) -> Result<Vec<Self>, StepFailed> {
        let broken = |reason: String| StepFailed::Broken(format!("reading {}: {reason}", path.display()));
        let text = std::fs::read_to_string(path).map_err(|error| broken(error.to_string()))?;
        let pose = |line: &str| -> Option<Self> {
            let numbers: Vec<f64> = line.split_whitespace().map_while(|word| word.parse().ok()).collect();
            let column = |k: usize| Some([*numbers.get(k)?, *numbers.get(k + 4)?, *numbers.get(k + 8)?]);
            Some(Self { position_m: column(3)?, forward: column(2)? })
        };
        text.lines().map(|line| pose(line).ok_or_else(|| broken(format!("no pose: {line}")))).collect()
    }

    fn distance_m(&self, other: &Self) -> f64 {
        self.position_m.iter().zip(other.position_m).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
    }

    fn shows_the_same_as(&self, other: &Self) -> bool {
        let cosine: f64 = self.forward.iter().zip(other.forward).map(|(a, b)| a * b).sum();
        self.distance_m(other) < REVISIT_M && cosine > REVISIT_COSINE
    }
}

/// A loop that was closed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ClosedLoop {
    /// Frame that saw an older place.
    pub frame: usize,
    /// Frame that the place was first seen from.
    pub old_frame: usize,
}

/// What `loops.csv` says.
#[derive(Debug, Default)]
pub(super) struct LoopLog {
    /// Frames of all keyframes.
    pub keyframes: Vec<usize>,
    /// Loops that were closed.
    pub closed: Vec<ClosedLoop>,
    /// Candidates by what was decided about them.
    pub decisions: BTreeMap<String, usize>,
}

impl LoopLog {
    /// Reads the table of an output folder.
    pub fn read(out: &Path) -> Result<Self, StepFailed> {
        let table = Table::read(&out.join("loops.csv"))?;
        let mut log = Self::default();
        let mut frame_of_keyframe = BTreeMap::new();
        for row in table.rows(["frame", "keyframe", "candidate", "decision"])? {
            let [frame, keyframe, candidate, decision] = row;
            let frame: usize = table.number(frame)?;
            if frame_of_keyframe.insert(table.number::<u32>(keyframe)?, frame).is_none() {
                log.keyframes.push(frame);
            }
            if candidate.is_empty() {
                continue;
            }
            *log.decisions.entry(decision.to_owned()).or_default() += 1;
            // A keyframe of an earlier drive has no frame here.
            if let ("accepted", Some(&old_frame)) = (decision, frame_of_keyframe.get(&table.number::<u32>(candidate)?))
            {
                log.closed.push(ClosedLoop { frame, old_frame });
            }
        }
        Ok(log)
    }

    /// Candidates that are no loops, by the reason, the most frequent first.
    pub fn refused(&self) -> String {
        let mut refused: Vec<_> = self.decisions.iter().filter(|(decision, _)| *decision != "accepted").collect();
        refused.sort_by_key(|(_, n)| std::cmp::Reverse(**n));
        refused.iter().map(|(decision, n)| format!("{n} {}", decision.replace('_', " "))).collect::<Vec<_>>().join(", ")
    }
}

/// A run against the truth.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Judgement {
    /// Closed loops of one place with another.
    pub n_wrong: usize,
    /// Keyframes that see an older place again.
    pub n_revisits: usize,
    /// Of these: with a right loop near by.
    pub n_found: usize,
    /// Streets that are driven again.
    pub n_streets: usize,
    /// Of these: with a right loop.
    pub n_streets_found: usize,
}

impl Judgement {
    /// Compares what was closed with the true poses, one per frame.
    pub fn of(log: &LoopLog, truth: &[TruePose]) -> Self {
        let pose = |frame: usize| truth.get(frame);
        let is_right = |l: &ClosedLoop| match (pose(l.frame), pose(l.old_frame)) {
            (Some(now), Some(then)) => now.distance_m(then) < RIGHT_M,
            _ => false,
        };
        let way_m = way_m(truth);
        let near = |a: usize, b: usize, most_m: f64| (way_m[a] - way_m[b]).abs() <= most_m;
        let right: Vec<usize> = log.closed.iter().filter(|l| is_right(l)).map(|l| l.frame).collect();
        let revisits = revisits(&log.keyframes, truth);
        let is_found = |frame: usize| right.iter().any(|&closed| near(closed, frame, FOUND_M));
        let mut judgement = Self {
            n_wrong: log.closed.len() - right.len(),
            n_revisits: revisits.len(),
            n_found: revisits.iter().filter(|&&frame| is_found(frame)).count(),
            ..Self::default()
        };
        for street in revisits.chunk_by(|&a, &b| near(a, b, SAME_STREET_M)) {
            judgement.n_streets += 1;
            let (first, last) = (street[0], street[street.len() - 1]);
            let is_here = |&closed: &usize| (first..=last).contains(&closed) || is_near_end(&near, closed, street);
            judgement.n_streets_found += usize::from(right.iter().any(is_here));
        }
        judgement
    }
}

fn is_near_end(near: &impl Fn(usize, usize, f64) -> bool, closed: usize, street: &[usize]) -> bool {
    street.first().into_iter().chain(street.last()).any(|&end| near(closed, end, FOUND_M))
}

/// Frames of the keyframes that see a place of an older keyframe again.
fn revisits(keyframes: &[usize], truth: &[TruePose]) -> Vec<usize> {
    let at = |k: usize| keyframes.get(k).and_then(|&frame| truth.get(frame));
    let sees_older = |k: usize| {
        let older = 0..(k + 1).saturating_sub(MIN_GAP_KEYFRAMES);
        at(k).is_some_and(|now| older.filter_map(at).any(|then| now.shows_the_same_as(then)))
    };
    (0..keyframes.len()).filter(|&k| sees_older(k)).map(|k| keyframes[k]).collect()
}

/// Frames, of all in `frames`, in streets that are driven more than once.
pub(super) fn in_revisited_streets(frames: &BTreeSet<usize>, keyframes: &[usize], truth: &[TruePose]) -> Vec<usize> {
    let is_again = |frame: usize| {
        let own = keyframes.partition_point(|&keyframe| keyframe < frame);
        let is_other = |k: usize| k.abs_diff(own) >= MIN_GAP_KEYFRAMES;
        let mut others = keyframes.iter().enumerate().filter(|(k, _)| is_other(*k)).filter_map(|(_, &f)| truth.get(f));
        truth.get(frame).is_some_and(|now| others.any(|other| now.shows_the_same_as(other)))
    };
    frames.iter().copied().filter(|&frame| is_again(frame)).collect()
}

/// Metres driven up to each frame.
fn way_m(truth: &[TruePose]) -> Vec<f64> {
    let steps = truth.windows(2).scan(0.0, |way_m, pair| {
        *way_m += pair[0].distance_m(&pair[1]);
        Some(*way_m)
    });
    std::iter::once(0.0).chain(steps).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Twice around a square of 100 m, a pose per metre.
    fn square() -> Vec<TruePose> {
        let pose = |k: usize| {
            let (side, along) = (k / 25 % 4, (k % 25) as f64);
            let (x, z, forward) = match side {
                0 => (0.0, along, [0.0, 0.0, 1.0]),
                1 => (along, 25.0, [1.0, 0.0, 0.0]),
                2 => (25.0, 25.0 - along, [0.0, 0.0, -1.0]),
                _ => (25.0 - along, 0.0, [-1.0, 0.0, 0.0]),
            };
            TruePose { position_m: [x, 0.0, z], forward }
        };
        (0..200).map(pose).collect()
    }

    #[test]
    fn loops_are_judged_by_where_the_vehicle_was() {
        let truth = square();
        let check = |closed: &[(usize, usize)], expected: [usize; 3]| {
            let closed = closed.iter().map(|&(frame, old_frame)| ClosedLoop { frame, old_frame }).collect();
            let log = LoopLog { keyframes: (0..200).collect(), closed, ..LoopLog::default() };
            let found = Judgement::of(&log, &truth);
            assert_eq!((found.n_revisits, found.n_streets), (100, 1));
            assert_eq!([found.n_wrong, found.n_found, found.n_streets_found], expected);
        };
        check(&[], [0, 0, 0]);
        check(&[(150, 50)], [0, 21, 1]);
        check(&[(150, 50), (153, 53)], [0, 24, 1]);
        // Across the square, and the same street in the other direction.
        check(&[(150, 0)], [1, 0, 0]);
    }

    #[test]
    fn a_log_becomes_loops_and_reasons() {
        let dir = tempfile::tempdir().expect("a folder");
        let csv = "frame,keyframe,candidate,decision,score\n0,0,,no_candidate,\n3,1,,no_candidate,\n9,2,0,too_few_matches,0.1\n\
                   9,2,1,accepted,0.1\n12,3,1,too_few_matches,0.2\n12,3,0,one_patch,0.1\n";
        std::fs::write(dir.path().join("loops.csv"), csv).expect("a file");
        let log = LoopLog::read(dir.path()).map_err(|e| e.to_string()).expect("a log");
        assert_eq!(log.keyframes, [0, 3, 9, 12]);
        assert_eq!(log.closed, [ClosedLoop { frame: 9, old_frame: 3 }]);
        assert_eq!(log.refused(), "2 too few matches, 1 one patch");
    }

    #[test]
    fn both_passages_of_a_street_are_revisited() {
        let truth = square();
        let keyframes: Vec<usize> = (0..130).collect();
        let frames = BTreeSet::from([10, 20, 60, 110, 125]);
        assert_eq!(in_revisited_streets(&frames, &keyframes, &truth), [10, 20, 110, 125]);
    }
}
