//! What a camera needs of which page: everything nearby, of pages farther away only what is seen from afar.

use crate::map_store::MapStoreReader;
use crate::splat::Capacities;
use kilogs_core::map::lod::{N_LEVELS, visible_range_m};
use kilogs_core::store::PageLabel;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// An anchor ahead of its keyframe that a camera sees ahead of itself is no farther from the keyframe than its
/// level is visible, so neither is the camera. The slack is for bends, where "ahead" turns.
const REACH_SLACK_RATIO: f64 = 1.1;

/// What the backend has room for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Room {
    pub(crate) anchors: usize,
    pub(crate) keyframe_rows: usize,
    pub(crate) chunk_rows: usize,
}

impl Room {
    /// All that a backend has.
    pub(crate) fn of(capacities: &Capacities) -> Self {
        Self { anchors: capacities.anchors, keyframe_rows: capacities.keyframe_rows, chunk_rows: capacities.chunk_rows }
    }
}

/// A page whose file was found whole, and its anchors of each level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CountedPage {
    pub(crate) label: PageLabel,
    pub(crate) n_anchors: [u32; N_LEVELS],
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
pub(crate) struct Wanted {
    /// Which of the counted pages.
    pub(crate) page_idx: usize,
    pub(crate) finest_level: u8,
}

/// Finest level that can be seen of a page whose nearest keyframe is `distance_m` from the camera.
fn finest_level_at(distance_m: f64) -> u8 {
    let hidden = |level: &u8| f64::from(visible_range_m(*level).1) * REACH_SLACK_RATIO < distance_m;
    (0..N_LEVELS as u8).take_while(hidden).count() as u8
}

/// From where a map is looked at.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Standpoint<'a> {
    /// Where the cameras are, in the map.
    pub(crate) positions_m: &'a [Vector3<f64>],
    /// Chunks that need a row whatever else does.
    pub(crate) chunk_ids: &'a [u32],
    /// Pages up to so far away are wanted with all their levels, m.
    pub(crate) whole_within_m: f64,
}

impl Standpoint<'_> {
    fn distance_m(&self, map: &MapStoreReader, page: &PageLabel) -> f64 {
        self.positions_m.iter().map(|position_m| map.page_distance_m(page, position_m)).fold(f64::INFINITY, f64::min)
    }

    fn finest_level_at(&self, distance_m: f64) -> u8 {
        if distance_m <= self.whole_within_m { 0 } else { finest_level_at(distance_m) }
    }
}

/// Picks pages by distance from the nearest camera until something is full, nearest first. `ranked` and `wanted` are
/// emptied and filled: the caller keeps their memory. Whether everything that can be seen fits.
pub(crate) fn pick_pages(
    map: &MapStoreReader,
    pages: &[CountedPage],
    standpoint: &Standpoint<'_>,
    room: &Room,
    ranked: &mut Vec<(f64, usize)>,
    wanted: &mut Vec<Wanted>,
) -> bool {
    ranked.clear();
    wanted.clear();
    ranked.extend(pages.iter().enumerate().map(|(idx, page)| (standpoint.distance_m(map, &page.label), idx)));
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));

    let mut n_anchors = 0;
    let mut keyframe_ids = BTreeSet::new();
    let mut chunk_ids: BTreeSet<u32> = standpoint.chunk_ids.iter().copied().collect();
    for (distance_m, page_idx) in ranked.iter() {
        let page = &pages[*page_idx];
        let label = &page.label;
        let Some(finest_level) = page.first_level_from(standpoint.finest_level_at(*distance_m)) else { continue };
        let n_needed = page.anchors_from(finest_level);
        let new_keyframes = (label.first_keyframe_id..=label.last_keyframe_id).filter(|id| !keyframe_ids.contains(id));
        let new_chunk = usize::from(!chunk_ids.contains(&label.chunk_id));
        let fits = n_anchors + n_needed <= room.anchors
            && keyframe_ids.len() + new_keyframes.count() <= room.keyframe_rows
            && chunk_ids.len() + new_chunk <= room.chunk_rows;
        if !fits {
            // A hole near the camera is worse than nothing far away: stop at the first page that is too much.
            return false;
        }
        n_anchors += n_needed;
        keyframe_ids.extend(label.first_keyframe_id..=label.last_keyframe_id);
        chunk_ids.insert(label.chunk_id);
        wanted.push(Wanted { page_idx: *page_idx, finest_level });
    }
    true
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
