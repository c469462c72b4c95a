//! What a step trains with, by how far the training is.

use crate::splat::{LearningRate, LearningRates, StepSettings};

/// Training resolutions relative to the camera's, and the progress at which each begins.
const RESOLUTIONS: [(f64, f64); 3] = [(0.0, 0.25), (0.2, 0.5), (0.5, 1.0)];

/// Progress at which the map is pruned, and bare and wrong places are inserted once more.
pub(super) const REVISITS: [f64; 2] = [0.2, 0.5];

/// Training resolution at a progress in [0, 1].
pub(super) fn resolution(progress: f64) -> f64 {
    let begun = RESOLUTIONS.iter().rev().find(|(begins, _)| progress >= *begins);
    begun.map_or(RESOLUTIONS[0].1, |(_, resolution)| *resolution)
}

/// The mapper's step with rates that fall to the end.
pub(super) fn step(mapper: &StepSettings, progress: f64) -> StepSettings {
    let rates = LearningRates {
        log_scale: falling(mapper.rates.log_scale),
        rotation: falling(mapper.rates.rotation),
        opacity: falling(mapper.rates.opacity),
        ..mapper.rates
    };
    StepSettings { rates, progress: progress as f32, ..*mapper }
}

/// A tenth at the end.
fn falling(rate: LearningRate) -> LearningRate {
    LearningRate { start: rate.start, end: rate.end.min(0.1 * rate.start) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn training_ends_at_native_resolution() {
        for (progress, expected) in [(0.0, 0.25), (0.19, 0.25), (0.2, 0.5), (0.5, 1.0), (1.0, 1.0), (2.0, 1.0)] {
            assert_eq!(resolution(progress), expected, "{progress}");
        }
    }
}
