//! Which pages a camera needs: the nearest, as many as fit.

use crate::map_store::MapStoreReader;
use kilogs_core::store::PageLabel;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// How far ahead of the camera the picture is made of small things: pages are ranked by their distance from there.
pub(super) const LOOK_AHEAD_M: f64 = 15.0;

/// What the backend has room for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Room {
    pub(super) anchors: usize,
    pub(super) keyframe_rows: usize,
    pub(super) chunk_rows: usize,
}

/// Picks pages by distance from `focus_in_map_m` until something is full; nearest first, `usable` says which may
/// be picked at all. `view_chunk_id` needs a chunk row whatever else does.
///
/// `picked` and `ranked` are emptied and filled: the caller keeps their memory.
pub(super) fn pick_pages(
    map: &MapStoreReader,
    focus_in_map_m: &Vector3<f64>,
    view_chunk_id: u32,
    room: &Room,
    usable: impl Fn(&PageLabel) -> bool,
    ranked: &mut Vec<(f64, PageLabel)>,
    picked: &mut Vec<PageLabel>,
) {
    ranked.clear();
    picked.clear();
    let candidates = map.pages().iter().filter(|page| usable(page));
    ranked.extend(candidates.map(|page| (map.page_distance_m(page, focus_in_map_m), *page)));
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.page_id.cmp(&b.1.page_id)));

    let mut n_anchors = 0;
    let mut keyframe_ids = BTreeSet::new();
    let mut chunk_ids = BTreeSet::from([view_chunk_id]);
    for (_, page) in ranked.iter() {
        let new_keyframes = (page.first_keyframe_id..=page.last_keyframe_id).filter(|id| !keyframe_ids.contains(id));
        let new_chunk = usize::from(!chunk_ids.contains(&page.chunk_id));
        let fits = n_anchors + page.n_anchors as usize <= room.anchors
            && keyframe_ids.len() + new_keyframes.count() <= room.keyframe_rows
            && chunk_ids.len() + new_chunk <= room.chunk_rows;
        if !fits {
            // A hole near the camera is worse than nothing far away: stop at the first page that is too much.
            break;
        }
        n_anchors += page.n_anchors as usize;
        keyframe_ids.extend(page.first_keyframe_id..=page.last_keyframe_id);
        chunk_ids.insert(page.chunk_id);
        picked.push(*page);
    }
}
