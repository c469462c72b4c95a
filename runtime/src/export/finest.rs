//! One level per place: of the anchors that describe the same voxel, the finest that is wanted.
//!
//! A map holds a surface once per distance from which it was seen, and drawing fades between these levels by the
//! camera's distance. A file without levels can show only one of them.

use super::walk::{PageWalk, WalkError, WalkedAnchor};
use kilogs_core::conventions::rotation_from_xyzw;
use kilogs_core::map::lod::N_LEVELS;
use kilogs_core::map::voxel::VoxelKey;
use kilogs_core::store::PageLabel;
use nalgebra::Vector3;

/// Coarse anchors that are decided in one pass over the map: 16 MiB.
const BATCH_ANCHORS: usize = 1 << 20;

/// Which anchors of a map are shown; one bit each.
#[derive(Debug, Clone)]
pub(super) struct Shown {
    hidden: Vec<u64>,
}

impl Shown {
    /// Everything.
    pub(super) fn all(n_anchors: usize) -> Self {
        Self { hidden: vec![0; n_anchors.div_ceil(64)] }
    }

    pub(super) fn contains(&self, anchor_idx: usize) -> bool {
        self.hidden.get(anchor_idx / 64).is_none_or(|bits| bits >> (anchor_idx % 64) & 1 == 0)
    }

    fn hide(&mut self, anchor_idx: usize) {
        if let Some(bits) = self.hidden.get_mut(anchor_idx / 64) {
            *bits |= 1 << (anchor_idx % 64);
        }
    }
}

/// Passes over the map of which [`finest`] tells.
pub(super) fn n_passes(pages: &[PageLabel]) -> usize {
    1 + pages.iter().map(|page| page.n_anchors as usize).sum::<usize>() / BATCH_ANCHORS
}

/// Hides every anchor finer than `finest_level` in whose voxel there is one of that level or a coarser one, and of the others
/// every anchor in whose voxel there is a finer one.
pub(super) fn finest(
    reading: &mut PageWalk<'_>,
    pages: &[PageLabel],
    finest_level: u8,
    page_done: impl Fn(),
) -> Result<Shown, WalkError> {
    finest_in_batches(reading, pages, finest_level, BATCH_ANCHORS, page_done)
}

fn finest_in_batches(
    reading: &mut PageWalk<'_>,
    pages: &[PageLabel],
    finest_level: u8,
    batch_anchors: usize,
    page_done: impl Fn(),
) -> Result<Shown, WalkError> {
    let n_anchors = pages.iter().map(|page| page.n_anchors as usize).sum();
    let mut wanted = Shown::all(n_anchors);
    let mut cells: Vec<(VoxelKey, bool)> = Vec::with_capacity(n_anchors.min(batch_anchors));
    for first in (0..n_anchors).step_by(batch_anchors.max(1)).filter(|_| finest_level > 0) {
        let batch = first..first + batch_anchors;
        collect(reading, pages, &mut cells, |walked| {
            batch.contains(&walked.anchor_idx) && walked.anchor.level >= finest_level
        })?;
        reading.walk(pages, || (), &mut |walked| {
            let is_finer = walked.anchor.level < finest_level;
            let mut levels = (finest_level..N_LEVELS as u8).filter(|_| is_finer);
            if levels.any(|level| voxel(walked, level).and_then(|cell| find(&cells, cell)).is_some()) {
                wanted.hide(walked.anchor_idx);
            }
            Ok(())
        })?;
    }
    let mut shown = wanted.clone();
    for first in (0..n_anchors).step_by(batch_anchors.max(1)) {
        let batch = first..first + batch_anchors;
        collect(reading, pages, &mut cells, |walked| batch.contains(&walked.anchor_idx) && walked.anchor.level > 0)?;
        reading.walk(pages, || (), &mut |walked| {
            for level in walked.anchor.level.saturating_add(1)..N_LEVELS as u8 {
                let found = voxel(walked, level).and_then(|cell| find(&cells, cell));
                if let Some((_, covered)) = found.and_then(|idx| cells.get_mut(idx)) {
                    *covered |= wanted.contains(walked.anchor_idx);
                }
            }
            Ok(())
        })?;
        reading.walk(pages, &page_done, &mut |walked| {
            let own = voxel(walked, walked.anchor.level).filter(|_| batch.contains(&walked.anchor_idx));
            let covered = own.and_then(|cell| cells.get(find(&cells, cell)?)).is_some_and(|(_, covered)| *covered);
            if covered {
                shown.hide(walked.anchor_idx);
            }
            Ok(())
        })?;
    }
    Ok(shown)
}

/// The voxels of some anchors, in order, none of them covered yet.
fn collect(
    reading: &mut PageWalk<'_>,
    pages: &[PageLabel],
    cells: &mut Vec<(VoxelKey, bool)>,
    wanted: impl Fn(&WalkedAnchor<'_>) -> bool,
) -> Result<(), WalkError> {
    cells.clear();
    reading.walk(pages, || (), &mut |walked| {
        cells.extend(voxel(walked, walked.anchor.level).filter(|_| wanted(walked)).map(|cell| (cell, false)));
        Ok(())
    })?;
    cells.sort_unstable();
    cells.dedup();
    Ok(())
}

fn find(cells: &[(VoxelKey, bool)], cell: VoxelKey) -> Option<usize> {
    cells.binary_search_by_key(&cell, |(known, _)| *known).ok()
}

/// Voxel of `level` in which an anchor lies.
fn voxel(walked: &WalkedAnchor<'_>, level: u8) -> Option<VoxelKey> {
    let keyframe = walked.keyframe?;
    let in_keyframe_m = Vector3::from(walked.anchor.position_in_keyframe_m.map(f64::from));
    let map_from_keyframe = rotation_from_xyzw(keyframe.rotation_xyzw);
    let in_map_m = map_from_keyframe * in_keyframe_m * keyframe.scale + Vector3::from(keyframe.translation_m);
    VoxelKey::containing(level, in_map_m.into())
}

#[cfg(test)]
mod tests {
    use super::super::tests::{create_store, gaussian, keyframe};
    use super::*;
    use crate::map_store::MapStoreReader;
    use kilogs_core::camera::Pinhole;
    use kilogs_core::store::StoredAnchor;
    use std::path::Path;

    /// Two pages, keyframes at z = 0 and 10 m; `(keyframe, level, x, z)` of every anchor.
    fn write_map(folder: &Path, anchors: &[(u32, u8, f32, f32)]) {
        let camera = Pinhole { width: 16, height: 8, fx: 10.0, fy: 10.0, cx: 8.0, cy: 4.0 };
        let store = create_store(folder, camera, 4096);
        for id in 0..2 {
            store.place_keyframe(&keyframe(id)).expect("taken");
            let label = PageLabel { page_id: id, first_keyframe_id: id, last_keyframe_id: id, ..PageLabel::default() };
            let mut page = store.begin_page(label).expect("a buffer");
            for (_, level, x, z) in anchors.iter().filter(|anchor| anchor.0 == id) {
                let anchor = StoredAnchor {
                    position_in_keyframe_m: [*x, 0.05, *z],
                    keyframe_id: id,
                    log_extent: [0.0; 3],
                    level: *level,
                    n_gaussians: 1,
                    feature_kind: 0,
                };
                page.push(&anchor, &[gaussian(0.0)]).expect("room");
            }
            store.commit_page(page).expect("taken");
        }
        store.finish().expect("written");
    }

    #[test]
    fn a_voxel_shows_the_finest_level_that_is_wanted_whatever_page_its_anchors_are_on() {
        // Seen from the first keyframe: a 5 m voxel at z 10-15 and one at z 20-25, a 1 m voxel at z 12-13; from the
        // second: a 0.25 m one at z 12.6 and a 0.1 m one at z 30, where nothing coarser is.
        let anchors = [
            (0, 3, 2.5, 12.5),
            (0, 3, 2.5, 22.5),
            (0, 2, 0.5, 12.5),
            (0, 2, 3.5, 12.5),
            (1, 1, 0.6, 2.6),
            (1, 0, 0.5, 20.0),
        ];
        let expected = [
            (0, [false, true, false, true, true, true]),
            (1, [false, true, false, true, true, true]),
            (2, [false, true, true, true, false, true]),
            (3, [true, true, false, false, false, true]),
        ];
        for ((finest_level, expected), batch_anchors) in expected.iter().flat_map(|row| [1, 2, 100].map(|n| (row, n))) {
            let scratch = tempfile::tempdir().expect("a scratch folder");
            write_map(scratch.path(), &anchors);
            let map = MapStoreReader::open(scratch.path(), 10).expect("the store opens");
            let mut reading = PageWalk::new(&map);
            let shown = finest_in_batches(&mut reading, map.pages(), *finest_level, batch_anchors, || ());
            let shown = shown.ok().expect("read");
            let found: Vec<bool> = (0..anchors.len()).map(|idx| shown.contains(idx)).collect();
            assert_eq!(found, expected, "level {finest_level}, batches of {batch_anchors}");
        }
    }
}
