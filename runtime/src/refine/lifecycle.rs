//! Which anchors of a stretch deserve more Gaussians, and which none: scores over a few of its views (method.md 12).
//!
//! Scores are a stretch's own; no pass ever needs all views of a map.

use super::settings::{LifecycleSettings, PruneScore};
use crate::splat::AnchorScore;

/// Images so wide are what [`LifecycleSettings::densify_px`] is meant for.
const PAPER_WIDTH_PX: f64 = 480.0;
/// Scores that differ by less say nothing: the worst of equals is as good as the best.
const MIN_SPREAD: f64 = 0.5;

/// What the views said about every slot so far.
pub(super) struct Tally {
    slots: Vec<SlotTally>,
    n_views: u32,
}

#[derive(Debug, Clone, Copy, Default)]
struct SlotTally {
    /// Pixels where it contributes and the picture is wrong, at the paper's width, summed over the views.
    masked_px: f64,
    /// Contributions, summed over the views.
    covered: f64,
    /// Sum of what the pruning score sums.
    guilt: f64,
}

impl Tally {
    pub(super) fn new(n_slots: usize) -> Self {
        Self { slots: vec![SlotTally::default(); n_slots], n_views: 0 }
    }

    /// Adds a view of this width with its photometric loss.
    pub(super) fn add(&mut self, scores: &[AnchorScore], (loss, width_px): (f32, u32), kind: PruneScore) {
        let to_paper = (PAPER_WIDTH_PX / f64::from(width_px.max(1))).powi(2);
        for (slot, score) in self.slots.iter_mut().zip(scores) {
            slot.masked_px += f64::from(score.masked) * to_paper;
            slot.covered += f64::from(score.covered);
            let pixels = match kind {
                PruneScore::Paper => score.covered,
                PruneScore::ErrorWeighted => score.masked,
            };
            slot.guilt += f64::from(loss) * f64::from(pixels);
        }
        self.n_views += 1;
    }

    /// Whether so much of what a slot shows is wrong that it needs more Gaussians: `S_d > 5`.
    pub(super) fn needs_more(&self, slot: u32, settings: &LifecycleSettings) -> bool {
        let masked_px = self.slots.get(slot as usize).map_or(0.0, |slot| slot.masked_px);
        settings.densify && masked_px / f64::from(self.n_views.max(1)) > settings.densify_px
    }

    /// Slots whose pruning score is above the limit: the min-max of `ln(1 + sum of loss * pixels)` over the slots that
    /// are seen at all.
    pub(super) fn guilty(&self, slots: &[u32], settings: &LifecycleSettings) -> Vec<u32> {
        let score =
            |slot: &u32| self.slots.get(*slot as usize).filter(|slot| slot.covered > 0.0).map(|s| s.guilt.ln_1p());
        let (low, high) = slots
            .iter()
            .filter_map(score)
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), score| (low.min(score), high.max(score)));
        let spread = high - low;
        if !settings.prune || spread.partial_cmp(&MIN_SPREAD) != Some(std::cmp::Ordering::Greater) {
            return Vec::new();
        }
        let is_guilty = |slot: &&u32| score(slot).is_some_and(|score| (score - low) / spread > settings.prune_score);
        slots.iter().filter(is_guilty).copied().collect()
    }

    /// Of slots with so many Gaussians each, those that contribute least, as many as it takes to leave at most `most`
    /// Gaussians.
    pub(super) fn least_seen(&self, slots: &[(u32, u32)], most: u64) -> Vec<u32> {
        let covered = |slot: u32| self.slots.get(slot as usize).map_or(0.0, |slot| slot.covered);
        let mut ranked = slots.to_vec();
        // What shows least for each of its Gaussians goes first.
        let worth = |&(slot, n_gaussians): &(u32, u32)| covered(slot) / f64::from(n_gaussians.max(1));
        ranked.sort_by(|a, b| worth(a).total_cmp(&worth(b)).then(a.0.cmp(&b.0)));
        let mut n_left: u64 = slots.iter().map(|(_, n_gaussians)| u64::from(*n_gaussians)).sum();
        let mut leaving = Vec::new();
        for (slot, n_gaussians) in ranked {
            if n_left <= most {
                break;
            }
            n_left -= u64::from(n_gaussians);
            leaving.push(slot);
        }
        leaving
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: LifecycleSettings = LifecycleSettings { densify: true, prune: true, ..LifecycleSettings::MEASURED };

    fn score(covered: u32, masked: u32) -> AnchorScore {
        AnchorScore { covered, masked, radius_px: 1.0 }
    }

    /// Two views of 480 px: the first is bad, the second good.
    fn tally(kind: PruneScore, scores: &[[AnchorScore; 2]]) -> Tally {
        let mut tally = Tally::new(scores.len());
        for (view, loss) in [(0, 0.5), (1, 0.1)] {
            let of_view: Vec<AnchorScore> = scores.iter().map(|scores| scores[view]).collect();
            tally.add(&of_view, (loss, 480), kind);
        }
        tally
    }

    #[test]
    fn what_is_wrong_in_five_pixels_a_view_needs_more() {
        let none = score(0, 0);
        let tally = tally(PruneScore::Paper, &[[score(50, 12), none], [score(50, 10), none], [none, none]]);
        let needs = |settings: &LifecycleSettings| [0, 1, 2, 9].map(|slot| tally.needs_more(slot, settings));
        assert_eq!(needs(&SETTINGS), [true, false, false, false]);
        assert_eq!(needs(&LifecycleSettings { densify: false, ..SETTINGS }), [false; 4]);
    }

    #[test]
    fn pixels_count_as_at_the_paper_s_width() {
        let mut tally = Tally::new(1);
        tally.add(&[score(100, 24)], (0.1, 960), PruneScore::Paper);
        assert!(tally.needs_more(0, &SETTINGS));
        let mut tally = Tally::new(1);
        tally.add(&[score(100, 19)], (0.1, 960), PruneScore::Paper);
        assert!(!tally.needs_more(0, &SETTINGS));
    }

    #[test]
    fn the_paper_prunes_what_covers_most_and_the_other_score_what_is_wrong_most() {
        let none = score(0, 0);
        let scores = [[score(1000, 2), score(1000, 0)], [score(40, 40), none], [score(5, 0), none], [none, none]];
        let guilty = |kind| tally(kind, &scores).guilty(&[0, 1, 2, 3], &SETTINGS);
        assert_eq!(guilty(PruneScore::Paper), [0]);
        assert_eq!(guilty(PruneScore::ErrorWeighted), [1]);
        // Among equals none is the worst, and what is not asked about stays.
        let equal = tally(PruneScore::Paper, &[[score(50, 5), none], [score(51, 5), none]]);
        assert!(equal.guilty(&[0, 1], &SETTINGS).is_empty());
        assert!(tally(PruneScore::Paper, &scores).guilty(&[], &SETTINGS).is_empty());
        let off = LifecycleSettings { prune: false, ..SETTINGS };
        assert!(tally(PruneScore::Paper, &scores).guilty(&[0, 1, 2], &off).is_empty());
    }

    #[test]
    fn what_shows_least_leaves_until_the_rest_fits() {
        let none = score(0, 0);
        let tally =
            tally(PruneScore::Paper, &[[score(90, 0), none], [score(10, 0), none], [none, none], [score(30, 0), none]]);
        let slots = [(0, 2), (1, 1), (2, 1), (3, 1)];
        for (most, expected) in [(5, &[][..]), (4, &[2]), (3, &[2, 1]), (2, &[2, 1, 3]), (0, &[2, 1, 3, 0])] {
            assert_eq!(tally.least_seen(&slots, most), expected, "{most}");
        }
    }
}
