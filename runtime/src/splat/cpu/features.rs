//! The anchors' features, and what the optimizer remembers about them.

use crate::splat::{AnchorFeature, Capacities};
use kilogs_core::map::decoder::NO_FEATURE;

/// One feature per anchor slot, or none at all.
pub struct Features {
    /// The numbers.
    pub values: Vec<AnchorFeature>,
    /// Adam's running mean of the gradient.
    pub first: Vec<AnchorFeature>,
    /// Of its square.
    pub second: Vec<AnchorFeature>,
    /// Steps taken, saturating.
    pub steps: Vec<u16>,
}

/// Bytes of one slot.
pub const FEATURE_BYTES: usize = 3 * size_of::<AnchorFeature>() + size_of::<u16>();

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

    /// Feature of a slot, `None` when it is out of range.
    pub fn read(&self, slot: u32) -> Option<&AnchorFeature> {
        self.values.get(slot as usize)
    }
}
