//! Where the points of keyframes are kept until a later view is measured against them.

use crate::features::Feature;
use crate::places::{BYTES_PER_PLACE_POINT, PlaceView, PointDepth, Signature};
use core::fmt;

/// The points of the keyframes that can be recognized, in numbered slots: only a candidate's are needed, so they may lie
/// where looking them up takes a while.
pub trait PlacePoints: fmt::Debug {
    /// Replaces what is in a slot. Whoever keeps it for another drive keeps the words, too
    /// ([`LoopCloser::recall`](super::LoopCloser::recall)).
    fn keep(&mut self, slot: usize, keyframe_id: u32, words: &Signature, view: &PlaceView<'_>);

    /// What was kept there; `None` when it cannot be had any more.
    fn find(&mut self, slot: usize) -> Option<PlaceView<'_>>;
}

/// [`PlacePoints`] in memory.
#[derive(Debug)]
pub struct PointsInMemory<'m> {
    /// `points_per_place` for each slot.
    pub features: &'m mut [Feature],
    /// As many.
    pub depths: &'m mut [PointDepth],
    /// One for each slot.
    pub n_points: &'m mut [usize],
    /// Room of a slot; what is beyond is not kept.
    pub points_per_place: usize,
}

impl PointsInMemory<'_> {
    /// Bytes of all slices.
    pub const fn bytes(n_slots: usize, points_per_place: usize) -> usize {
        n_slots * (points_per_place * BYTES_PER_PLACE_POINT + size_of::<usize>())
    }
}

impl PlacePoints for PointsInMemory<'_> {
    fn keep(&mut self, slot: usize, _: u32, _: &Signature, view: &PlaceView<'_>) {
        let n = view.features.len().min(view.depths.len()).min(self.points_per_place);
        let range = slot * self.points_per_place..slot * self.points_per_place + n;
        if let (Some(n_points), Some(features), Some(depths)) =
            (self.n_points.get_mut(slot), self.features.get_mut(range.clone()), self.depths.get_mut(range))
        {
            features.copy_from_slice(&view.features[..n]);
            depths.copy_from_slice(&view.depths[..n]);
            *n_points = n;
        }
    }

    fn find(&mut self, slot: usize) -> Option<PlaceView<'_>> {
        let range = slot * self.points_per_place..slot * self.points_per_place + *self.n_points.get(slot)?;
        Some(PlaceView { features: self.features.get(range.clone())?, depths: self.depths.get(range)? })
    }
}
