//! Which part of the route is trained when, and how.

use crate::fit;
use crate::splat::StepSettings;
use std::ops::Range;

/// How often the route is passed. The second time the stretches are shifted by half their length, so that no place is at
/// the end of a stretch both times.
const PASSES: usize = 2;

/// A part of the route that is trained together.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Part {
    /// Its keyframes, by their places in the map's list.
    pub(super) keyframes: Range<usize>,
    /// Share of the effort that is spent before and after it.
    pub(super) effort: Range<f64>,
    /// Progress of the learning rates before and after it.
    pub(super) progress: Range<f64>,
}

impl Part {
    /// Where the learning rates are when `spent` of all the effort is.
    pub(super) fn progress_at(&self, spent: f64) -> f64 {
        let length = (self.effort.end - self.effort.start).max(f64::EPSILON);
        let done = ((spent - self.effort.start) / length).clamp(0.0, 1.0);
        self.progress.start + done * (self.progress.end - self.progress.start)
    }
}

/// Share of a part's effort after which its Gaussians come and go: trained enough to be judged, and the rest of the part
/// to recover.
const RENEW_AT: f64 = 0.3;

impl Part {
    /// Share of all effort at which the part's lifecycle runs.
    pub(super) fn renews_at(&self) -> f64 {
        self.effort.start + RENEW_AT * (self.effort.end - self.effort.start)
    }
}

/// All parts in their order; every keyframe belongs to one part of each pass, and gets the same effort.
pub(super) fn parts(n_keyframes: usize, stretch_keyframes: usize) -> Vec<Part> {
    let share = |pass: usize, nth: usize| (pass as f64 + nth as f64 / n_keyframes.max(1) as f64) / PASSES as f64;
    let mut parts = Vec::new();
    for pass in 0..PASSES {
        for keyframes in stretches(n_keyframes, stretch_keyframes, pass % 2 == 1) {
            let effort = share(pass, keyframes.start)..share(pass, keyframes.end);
            let progress = pass as f64 / PASSES as f64..(pass + 1) as f64 / PASSES as f64;
            parts.push(Part { keyframes, effort, progress });
        }
    }
    parts
}

/// Cuts `n` keyframes into the fewest equal stretches of at most `longest`, or the same shifted by half a stretch.
fn stretches(n: usize, longest: usize, is_shifted: bool) -> Vec<Range<usize>> {
    let count = n.div_ceil(longest.max(1)).max(1);
    let cut = |halves: usize| (halves * n).div_ceil(2 * count).min(n);
    let cuts: Vec<usize> = match is_shifted && count > 1 {
        false => (0..=count).map(|nth| cut(2 * nth)).collect(),
        true => [0].into_iter().chain((0..count).map(|nth| cut(2 * nth + 1))).chain([n]).collect(),
    };
    cuts.windows(2).map(|ends| ends[0]..ends[1]).filter(|stretch| !stretch.is_empty()).collect()
}

/// Training resolution; `coarse` is the mapper's own.
pub(super) fn resolution(progress: f64, coarse: f64) -> f64 {
    if progress < COARSE_UNTIL { coarse } else { 1.0 }
}

/// Progress up to which steps are taken at the mapper's resolution, which costs a large image a third of the time.
const COARSE_UNTIL: f64 = 0.2;

/// The step of a fit.
pub(super) fn step(mapper: &StepSettings, progress: f64) -> StepSettings {
    fit::step(mapper, progress)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Where the stretches end.
    fn check(n: usize, longest: usize, ends: &[usize], shifted_ends: &[usize]) {
        for (is_shifted, expected) in [(false, ends), (true, shifted_ends)] {
            let found = stretches(n, longest, is_shifted);
            assert_eq!(found.iter().map(|stretch| stretch.end).collect::<Vec<_>>(), expected, "{n} in {longest}");
            let begins = [0].iter().chain(expected);
            assert!(found.iter().zip(begins).all(|(stretch, begin)| stretch.start == *begin), "{found:?}");
        }
    }

    #[test]
    fn the_route_is_cut_into_equal_stretches_and_then_between_them() {
        check(10, 10, &[10], &[10]);
        check(12, 10, &[6, 12], &[3, 9, 12]);
        check(3, 1, &[1, 2, 3], &[1, 2, 3]);
        check(0, 5, &[], &[]);
    }

    #[test]
    fn every_keyframe_gets_the_same_effort_in_both_passes() {
        for (n, longest) in [(1, 4), (130, 100), (701, 100), (7, 2)] {
            let mut effort = vec![0.0; n];
            let mut ends = 0.0;
            for part in parts(n, longest) {
                assert!((part.effort.start - ends).abs() < 1e-12, "{n}: {part:?}");
                ends = part.effort.end;
                let each = (part.effort.end - part.effort.start) / part.keyframes.len() as f64;
                effort[part.keyframes].iter_mut().for_each(|effort| *effort += each);
            }
            assert!((ends - 1.0).abs() < 1e-12);
            assert!(effort.iter().all(|effort| (effort * n as f64 - 1.0).abs() < 1e-9), "{n}: {effort:?}");
        }
    }

    #[test]
    fn rates_fall_through_a_part_from_where_the_last_pass_left_them() {
        let part = &parts(10, 10)[1];
        for (spent, progress) in [(0.5, 0.5), (0.75, 0.75), (1.0, 1.0), (1.3, 1.0), (0.0, 0.5)] {
            assert!((part.progress_at(spent) - progress).abs() < 1e-9, "{spent}");
        }
    }
}
