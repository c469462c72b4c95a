//! Going on in a map that was stored.

use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use super::pages::{PAGE_KEYFRAMES, group_and_part};
use crate::map_store::{Alignment, MapStoreReader};
use crate::splat::KeyframePlacement;
use kilogs_core::conventions::rotation_from_xyzw;
use nalgebra::Vector3;

impl Mapper {
    /// Makes the pages of `map` known to an empty mapper: they come back when the vehicle is near. The next chunk begins
    /// with the decoder of the last one. `alignment` is how the map's keyframes had moved when it was opened.
    pub fn resume(&mut self, map: &MapStoreReader, alignment: &Alignment) {
        self.alignment.copy_from(alignment);
        for keyframe in map.keyframes() {
            let placement = KeyframePlacement {
                rotation: rotation_from_xyzw(keyframe.rotation_xyzw),
                translation_m: Vector3::from(keyframe.translation_m),
                scale: keyframe.scale,
            };
            self.paging.directory.note(keyframe.keyframe_id, &placement);
        }
        for page in map.pages() {
            let (group, part) = group_and_part(page.page_id);
            let is_its_name = page.first_keyframe_id / PAGE_KEYFRAMES == group;
            if let Some(known) = self.paging.directory.get_mut(group).filter(|_| is_its_name) {
                known.parts.stored |= 1 << part;
                known.n_stored += page.n_anchors;
                known.revision = known.revision.max(page.revision);
            }
        }
        self.paging.directory.retain_stored();
        self.take_last_chunk(map);
    }

    fn take_last_chunk(&mut self, map: &MapStoreReader) {
        let Some(last) = map.chunks().map(|label| label.chunk_id).max() else { return };
        let mut bytes = Vec::new();
        if map.read_chunk(last, &mut bytes).is_err() || self.paging.chunk_rows.hold(last).is_none() {
            return;
        }
        self.take_chunk(last, Some(&bytes));
        // It is closed, as any chunk, when the first keyframe of the next one comes.
        self.paging.building_chunk = Some(last);
        self.decoders.go_on_after(last);
        self.sky.of_chunk = Some(last);
    }
}

/// Id of the first keyframe of a drive that goes on in a map: that of a new chunk, because the decoder of the last one is
/// frozen.
pub fn first_keyframe_id_after(map: &MapStoreReader) -> u32 {
    map.keyframes().last().map_or(0, |last| (last.keyframe_id / CHUNK_KEYFRAMES + 1) * CHUNK_KEYFRAMES)
}
