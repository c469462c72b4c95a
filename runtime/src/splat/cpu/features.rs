//! The anchors' features, and what the optimizer remembers about them.

use super::splats::take_front;
use crate::splat::{AnchorFeature, Capacities};
use kilogs_core::map::decoder::NO_FEATURE;

/// One feature per anchor slot, or none at all.
pub struct Features {
    values: Vec<AnchorFeature>,
    first: Vec<AnchorFeature>,
    second: Vec<AnchorFeature>,
    steps: Vec<u16>,
}

/// Bytes of one slot.
pub const FEATURE_BYTES: usize = 3 * size_of::<AnchorFeature>() + size_of::<u16>();

/// What training changes of the features of some consecutive slots.
pub struct FeatureStorage<'a> {
    /// The numbers.
    pub values: &'a mut [AnchorFeature],
    /// Adam's running mean of the gradient.
    pub first: &'a mut [AnchorFeature],
    /// Of its square.
    pub second: &'a mut [AnchorFeature],
    /// Steps taken, saturating.
    pub steps: &'a mut [u16],
    /// Where gradients go instead of a step being taken.
    pub collected: Option<&'a mut [AnchorFeature]>,
}

impl Features {
    /// Zeros; no slots when the decoder is not learned.
    pub fn new(capacities: &Capacities) -> Self {
        let n = if capacities.learned_decoder { capacities.anchors } else { 0 };
        Self { values: vec![NO_FEATURE; n], first: vec![NO_FEATURE; n], second: vec![NO_FEATURE; n], steps: vec![0; n] }
    }

    /// Sets a slot's feature and forgets its moments; false when the slot is out of range or a number not usable.
    pub fn write(&mut self, slot: u32, feature: &AnchorFeature) -> bool {
        let slot = slot as usize;
        if slot >= self.values.len() || !feature.iter().all(|v| v.is_finite()) {
            return false;
        }
        self.values[slot] = *feature;
        self.first[slot] = NO_FEATURE;
        self.second[slot] = NO_FEATURE;
        self.steps[slot] = 0;
        true
    }

    /// All features, one per slot.
    pub fn values(&self) -> &[AnchorFeature] {
        &self.values
    }

    /// What training changes.
    pub fn storage<'a>(&'a mut self, collected: Option<&'a mut [AnchorFeature]>) -> FeatureStorage<'a> {
        let Self { values, first, second, steps } = self;
        FeatureStorage { values, first, second, steps, collected }
    }
}

impl<'a> FeatureStorage<'a> {
    /// Cuts the first slots off.
    pub fn take_front(&mut self, n: usize) -> Self {
        FeatureStorage {
            values: take_front(&mut self.values, n),
            first: take_front(&mut self.first, n),
            second: take_front(&mut self.second, n),
            steps: take_front(&mut self.steps, n),
            collected: self.collected.as_mut().map(|rest| take_front(rest, n)),
        }
    }
}
