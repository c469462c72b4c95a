//! Whom an anchor is shown to: who sees it from far aside or from behind sees nothing of it, and needs one of his own.

use super::mapper::Mapper;
use super::pages::PAGE_KEYFRAMES;
use crate::splat::KeyframePlacement;
use kilogs_core::map::side::SIDE_BORDER_COSINE;
use kilogs_core::map::voxel::VoxelKey;
use nalgebra::Vector3;

impl Mapper {
    /// Whether the anchor in a slot shows its better half to who looks at its voxel from a place in the map, m.
    pub(super) fn is_shown_to(&self, slot: u32, voxel: VoxelKey, position_m: &Vector3<f64>) -> bool {
        let keyframe_in_map_m = self.ordinal_in(slot).and_then(|ordinal| self.keyframe_in_map_m(ordinal));
        let center_m = Vector3::from(voxel.center_in_map_m());
        keyframe_in_map_m.is_none_or(|keyframe_m| {
            let (from_keyframe, seen) = (center_m - keyframe_m, center_m - position_m);
            from_keyframe.dot(&seen) >= f64::from(SIDE_BORDER_COSINE) * from_keyframe.norm() * seen.norm()
        })
    }

    /// Where a keyframe is that the page directory knows, m.
    pub(super) fn keyframe_in_map_m(&self, ordinal: u32) -> Option<Vector3<f64>> {
        Some(self.placement_of(ordinal)?.translation_m)
    }

    /// The placement of a keyframe that the page directory knows.
    pub(super) fn placement_of(&self, ordinal: u32) -> Option<&KeyframePlacement> {
        self.paging.directory.get(ordinal / PAGE_KEYFRAMES)?.placement(ordinal)
    }
}
