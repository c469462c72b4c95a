//! What a camera needs of which page: everything nearby, of pages farther away only what is seen from afar.

use crate::map_store::MapStoreReader;
use kilogs_core::map::lod::{N_LEVELS, visible_range_m};
use kilogs_core::store::PageLabel;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// An anchor ahead of its keyframe that a camera sees ahead of itself is no farther from the keyframe than its
/// level is visible, so neither is the camera. The slack is for bends, where "ahead" turns.
const REACH_SLACK_RATIO: f64 = 1.1;

/// What the backend has room for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Room {
    pub(super) anchors: usize,
    pub(super) keyframe_rows: usize,
    pub(super) chunk_rows: usize,
}

/// A page whose file was found whole, and its anchors of each level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct CountedPage {
    pub(super) label: PageLabel,
    pub(super) n_anchors: [u32; N_LEVELS],
}

impl CountedPage {
    /// The finest level from `level` on that has anchors.
    fn first_level_from(&self, level: u8) -> Option<u8> {
        (level..N_LEVELS as u8).find(|level| self.n_anchors.get(usize::from(*level)).is_some_and(|n| *n > 0))
    }

    /// Anchors of `finest_level` and all coarser ones.
    fn anchors_from(&self, finest_level: u8) -> usize {
        self.n_anchors.iter().skip(usize::from(finest_level)).map(|n| *n as usize).sum()
    }
}

/// A page to be resident with all levels from the finest that can be seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Wanted {
    /// Which of the counted pages.
    pub(super) page_idx: usize,
    pub(super) finest_level: u8,
}

/// Finest level that can be seen of a page whose nearest keyframe is `distance_m` from the camera.
fn finest_level_at(distance_m: f64) -> u8 {
    let hidden = |level: &u8| f64::from(visible_range_m(*level).1) * REACH_SLACK_RATIO < distance_m;
    (0..N_LEVELS as u8).take_while(hidden).count() as u8
}

/// Picks pages by distance from the camera until something is full, nearest first. `view_chunk_id` needs a chunk row
/// whatever else does. `ranked` and `wanted` are emptied and filled: the caller keeps their memory.
pub(super) fn pick_pages(
    map: &MapStoreReader,
    pages: &[CountedPage],
    camera_in_map_m: &Vector3<f64>,
    view_chunk_id: u32,
    room: &Room,
    ranked: &mut Vec<(f64, usize)>,
    wanted: &mut Vec<Wanted>,
) {
    ranked.clear();
    wanted.clear();
    ranked.extend(pages.iter().enumerate().map(|(idx, page)| (map.page_distance_m(&page.label, camera_in_map_m), idx)));
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));

    let mut n_anchors = 0;
    let mut keyframe_ids = BTreeSet::new();
    let mut chunk_ids = BTreeSet::from([view_chunk_id]);
    for (distance_m, page_idx) in ranked.iter() {
        let page = &pages[*page_idx];
        let label = &page.label;
        let Some(finest_level) = page.first_level_from(finest_level_at(*distance_m)) else { continue };
        let n_needed = page.anchors_from(finest_level);
        let new_keyframes = (label.first_keyframe_id..=label.last_keyframe_id).filter(|id| !keyframe_ids.contains(id));
        let new_chunk = usize::from(!chunk_ids.contains(&label.chunk_id));
        let fits = n_anchors + n_needed <= room.anchors
            && keyframe_ids.len() + new_keyframes.count() <= room.keyframe_rows
            && chunk_ids.len() + new_chunk <= room.chunk_rows;
        if !fits {
            // A hole near the camera is worse than nothing far away: stop at the first page that is too much.
            break;
        }
        n_anchors += n_needed;
        keyframe_ids.extend(label.first_keyframe_id..=label.last_keyframe_id);
        chunk_ids.insert(label.chunk_id);
        wanted.push(Wanted { page_idx: *page_idx, finest_level });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_pages_are_wanted_for_their_coarse_levels_only() {
        // Levels are seen up to 21, 42, 84, 168 m and for ever; a tenth more is allowed for bends.
        for (distance_m, level) in
            [(0.0, 0), (23.0, 0), (23.2, 1), (46.0, 1), (92.0, 2), (184.0, 3), (185.0, 4), (1e9, 4)]
        {
            assert_eq!(finest_level_at(distance_m), level, "{distance_m} m");
        }
    }
}
