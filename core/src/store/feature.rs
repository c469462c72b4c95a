//! An anchor's feature as stored: one byte per number and their common step.

use crate::map::AnchorFeature;
use crate::map::decoder::FEATURE_LEN;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Steps from zero to the largest magnitude.
const MAX_STEPS: f32 = 127.0;

/// A feature whose numbers are multiples of `step`; each is off by at most half a step, which is 1/254 of the largest
/// magnitude among them.
#[derive(Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct StoredFeature {
    step: f32,
    steps: [i8; FEATURE_LEN],
}
const _: () = assert!(size_of::<StoredFeature>() == 36);

impl StoredFeature {
    /// The nearest multiples; `None` for a feature that is zero or not finite, which is not stored.
    pub fn nearest(feature: &AnchorFeature) -> Option<Self> {
        let largest = feature.iter().fold(0.0f32, |largest, value| largest.max(value.abs()));
        let step = largest / MAX_STEPS;
        if !feature.iter().all(|value| value.is_finite()) || step < f32::MIN_POSITIVE {
            return None;
        }
        // The cast saturates.
        Some(Self { step, steps: feature.map(|value| libm::roundf(value / step) as i8) })
    }

    /// The numbers.
    pub fn feature(&self) -> AnchorFeature {
        self.steps.map(|steps| f32::from(steps) * self.step)
    }

    /// Whether its numbers are usable.
    pub fn is_finite(&self) -> bool {
        (self.step * MAX_STEPS).is_finite()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::map::decoder::NO_FEATURE;
    use crate::math::Rng;

    #[test]
    fn numbers_come_back_within_half_a_step() {
        let mut rng = Rng::new(1, 2, 3);
        for scale in [1e-6, 0.3, 50.0] {
            let feature = NO_FEATURE.map(|_| scale * (2.0 * rng.unit_f32() - 1.0));
            let largest = feature.iter().fold(0.0f32, |largest, value| largest.max(value.abs()));
            let back = StoredFeature::nearest(&feature).expect("not zero").feature();
            let worst = feature.iter().zip(back).fold(0.0f32, |worst, (value, back)| worst.max((value - back).abs()));
            assert!(worst <= largest / 254.0 * 1.001, "scale {scale}: off by {worst}");
            assert_eq!(StoredFeature::nearest(&back).map(|stored| stored.feature()), Some(back), "storing again");
        }
    }

    #[test]
    fn what_says_nothing_is_not_stored() {
        let mut feature = NO_FEATURE;
        assert_eq!(StoredFeature::nearest(&feature), None);
        feature[4] = f32::NAN;
        assert_eq!(StoredFeature::nearest(&feature), None);
        feature[4] = f32::INFINITY;
        assert_eq!(StoredFeature::nearest(&feature), None);
    }
}
