//! What a step trains with, by how far the training is.

use crate::splat::{LearningRate, LearningRates, StepSettings};

/// Progress up to which steps are taken at the resolution of the insertion, which costs a large image a third of the
/// time. A quarter of the resolution teaches nothing: on the small KITTI 00 set a fifth of the steps at a quarter and
/// three tenths at half leave 0.7 dB less than all of them at native resolution.
const COARSE_UNTIL: f64 = 0.2;

/// Progress at which the map is pruned, and bare and wrong places are inserted once more.
pub(super) const REVISITS: [f64; 2] = [0.2, 0.5];

/// Share of the effort at which a section ends that trains `n_trained` views, of which `n_kept` are trained with the
/// next section's too, when `spent` is spent and `n_left` views are to come. Every view of a section gets the same
/// number of steps there, so a section of few new views needs as much as one of many.
pub(super) fn section_ends(spent: f64, (n_trained, n_kept): (usize, usize), n_left: usize) -> f64 {
    let n_new = n_trained.saturating_sub(n_kept).max(1);
    let n_more_sections = n_left.div_ceil(n_new);
    let n_to_train = n_left + n_more_sections * n_kept;
    spent + (1.0 - spent) * n_trained as f64 / (n_trained + n_to_train).max(1) as f64
}

/// Training resolution at a progress in [0, 1]; `coarse` is that of the insertion.
pub(super) fn resolution(progress: f64, coarse: f64) -> f64 {
    if progress < COARSE_UNTIL { coarse } else { 1.0 }
}

/// The mapper's step, faster at first and slower in the end than a drive's, of which nobody knows when it ends.
///
/// On 60 frames of the small KITTI 00 set, 1000 steps at native resolution, keyframes / held out: 23.12 / 22.11 dB with
/// scales, rotations and opacities falling to a tenth, 23.52 / 22.40 dB to three tenths, 23.83 / 22.65 dB with scales
/// and opacities twice as fast, 23.65 / 22.48 dB with only the first offsets twice as fast. A drive gains nothing by
/// the same rates.
pub(crate) fn step(mapper: &StepSettings, progress: f64) -> StepSettings {
    let rates = LearningRates {
        offset: LearningRate { start: 2.0 * mapper.rates.offset.start, ..mapper.rates.offset },
        log_scale: falling(mapper.rates.log_scale, 2.0),
        rotation: falling(mapper.rates.rotation, 1.0),
        opacity: falling(mapper.rates.opacity, 2.0),
        ..mapper.rates
    };
    StepSettings { rates, progress: progress as f32, ..*mapper }
}

/// Share of a rate that is left in the end.
const LEFT_IN_THE_END: f32 = 0.3;

fn falling(rate: LearningRate, factor: f32) -> LearningRate {
    let start = factor * rate.start;
    LearningRate { start, end: LEFT_IN_THE_END * start }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_begin_fast_and_fall() {
        let mapper = StepSettings::direct(0.0);
        let rate = |progress: f64| step(&mapper, progress).rates.log_scale.at(step(&mapper, progress).progress);
        let ratio = |progress: f64| rate(progress) / mapper.rates.log_scale.start;
        assert!((ratio(0.0) - 2.0).abs() < 1e-4 && (ratio(1.0) - 0.6).abs() < 1e-4, "{} {}", ratio(0.0), ratio(1.0));
    }

    #[test]
    fn every_section_gets_as_much_as_it_trains_views() {
        assert_eq!(section_ends(0.25, (80, 40), 0), 1.0);
        // A last section of 20 views trains 40 of this one again.
        assert_eq!(section_ends(0.0, (60, 40), 20), 0.5);
        // Sections of 80 views each, 40 of them new.
        let (mut ends, mut shares) = (0.0, Vec::new());
        for n_left in [120, 80, 40, 0] {
            let begins = ends;
            ends = section_ends(begins, (80, 40), n_left);
            shares.push(ends - begins);
        }
        assert!(shares.iter().all(|share| (share - 0.25).abs() < 1e-12), "{shares:?}");
    }

    #[test]
    fn training_ends_at_native_resolution() {
        for (progress, expected) in [(0.0, 0.5), (0.19, 0.5), (0.2, 1.0), (1.0, 1.0), (2.0, 1.0)] {
            assert_eq!(resolution(progress, 0.5), expected, "{progress}");
        }
    }
}
