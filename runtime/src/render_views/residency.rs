//! The pages that are in the backend, and what they hold there.

use super::row_table::RowTable;
use crate::map_store::{MapStoreReader, StoreError};
use crate::splat::{
    AnchorHeader, BACKGROUND_COLUMNS, BACKGROUND_TEXELS, GaussianParams, KeyframePlacement, SplatBackend,
};
use kilogs_core::conventions::rotation_from_xyzw;
use kilogs_core::store::{PageLabel, StoredKeyframe};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// Color of a direction whose chunk is lost.
const UNKNOWN_BACKGROUND: [f32; 3] = [0.5; 3];

/// A page in the backend.
#[derive(Debug)]
struct ResidentPage {
    label: PageLabel,
    slots: Vec<u32>,
}

/// Book of slots and rows; the backend itself is handed in.
#[derive(Debug)]
pub(super) struct Residency {
    pages: BTreeMap<u32, ResidentPage>,
    free_slots: Vec<u32>,
    keyframes: RowTable,
    chunks: RowTable,
    file: Vec<u8>,
    gaussians: Vec<GaussianParams>,
    texels: Vec<[f32; 3]>,
    /// Anchors that were not shown: their keyframe is lost or the backend refused them.
    pub(super) anchors_left_out: u64,
    /// Chunks without a readable background.
    pub(super) backgrounds_missing: u64,
}

impl Residency {
    pub(super) fn new(backend: &dyn SplatBackend) -> Self {
        let capacities = backend.capacities();
        let unused = GaussianParams {
            offset: [0.0; 3],
            log_scale: [0.0; 3],
            quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
            opacity_logit: 0.0,
            color_logit: [0.0; 3],
        };
        Self {
            pages: BTreeMap::new(),
            free_slots: (0..u32::try_from(capacities.anchors).unwrap_or(u32::MAX)).rev().collect(),
            keyframes: RowTable::new(capacities.keyframe_rows),
            chunks: RowTable::new(capacities.chunk_rows.min(usize::from(u16::MAX))),
            file: Vec::new(),
            gaussians: vec![unused; capacities.gaussians_per_anchor],
            texels: vec![UNKNOWN_BACKGROUND; BACKGROUND_TEXELS],
            anchors_left_out: 0,
            backgrounds_missing: 0,
        }
    }

    pub(super) fn holds(&self, page_id: u32) -> bool {
        self.pages.contains_key(&page_id)
    }

    pub(super) fn n_anchors(&self) -> usize {
        self.pages.values().map(|page| page.slots.len()).sum()
    }

    /// Takes every page out for which `keep` is false; returns how many.
    pub(super) fn evict(&mut self, backend: &mut dyn SplatBackend, keep: impl Fn(u32) -> bool) -> usize {
        let leaving: Vec<u32> = self.pages.keys().copied().filter(|page_id| !keep(*page_id)).collect();
        for page_id in &leaving {
            if let Some(page) = self.pages.remove(page_id) {
                self.forget(&page, backend);
            }
        }
        leaving.len()
    }

    fn forget(&mut self, page: &ResidentPage, backend: &mut dyn SplatBackend) {
        backend.retire_anchors(&page.slots);
        self.free_slots.extend(page.slots.iter().rev());
        for id in page.label.first_keyframe_id..=page.label.last_keyframe_id {
            self.keyframes.release(id);
        }
        self.chunks.release(page.label.chunk_id);
    }

    /// Puts a page into the backend. False when there is no room, which leaves nothing changed.
    ///
    /// # Errors
    /// [`StoreError`] when the page is damaged: nothing of it is shown.
    pub(super) fn load(
        &mut self,
        map: &MapStoreReader,
        page: &PageLabel,
        backend: &mut dyn SplatBackend,
    ) -> Result<bool, StoreError> {
        if page.n_anchors as usize > self.free_slots.len() {
            return Ok(false);
        }
        let Some(chunk_row) = self.hold_chunk(map, page.chunk_id, backend) else { return Ok(false) };
        if !self.hold_keyframes(map, page, backend) {
            self.chunks.release(page.chunk_id);
            return Ok(false);
        }
        let mut resident = ResidentPage { label: *page, slots: Vec::with_capacity(page.n_anchors as usize) };
        let loaded = self.load_anchors(map, chunk_row, &mut resident, backend);
        if loaded.is_err() {
            self.forget(&resident, backend);
        } else {
            self.pages.insert(page.page_id, resident);
        }
        loaded.map(|()| true)
    }

    fn load_anchors(
        &mut self,
        map: &MapStoreReader,
        chunk_row: u16,
        resident: &mut ResidentPage,
        backend: &mut dyn SplatBackend,
    ) -> Result<(), StoreError> {
        let (_, mut anchors) = map.read_page(resident.label.page_id, &mut self.file)?;
        while let Some(anchor) = anchors.next_anchor(&mut self.gaussians) {
            // A keyframe that the log lost has no row that was filled for it.
            let row = self.keyframes.row(anchor.keyframe_id).filter(|_| map.keyframe(anchor.keyframe_id).is_some());
            let fits = usize::from(anchor.n_gaussians) <= self.gaussians.len();
            let (Some(row), true, Some(slot)) = (row, fits, self.free_slots.pop()) else {
                self.anchors_left_out += 1;
                continue;
            };
            let header: AnchorHeader = anchor.to_header(row, chunk_row);
            let refused = backend.write_anchors(&[slot], &[header], &self.gaussians);
            if refused > 0 {
                self.anchors_left_out += 1;
                self.free_slots.push(slot);
            } else {
                resident.slots.push(slot);
            }
        }
        Ok(())
    }

    /// Rows for all keyframes of a page, or none of them.
    fn hold_keyframes(&mut self, map: &MapStoreReader, page: &PageLabel, backend: &mut dyn SplatBackend) -> bool {
        for id in page.first_keyframe_id..=page.last_keyframe_id {
            match self.keyframes.hold(id) {
                Some((row, true)) => {
                    if let Some(keyframe) = map.keyframe(id) {
                        backend.set_keyframes(row, &[placement(keyframe)]);
                    }
                }
                Some((_, false)) => {}
                None => {
                    (page.first_keyframe_id..id).for_each(|held| self.keyframes.release(held));
                    return false;
                }
            }
        }
        true
    }

    /// Row of a chunk, filled when it is new; `None` when all rows are in use.
    pub(super) fn hold_chunk(
        &mut self,
        map: &MapStoreReader,
        chunk_id: u32,
        backend: &mut dyn SplatBackend,
    ) -> Option<u16> {
        let (row, is_new) = self.chunks.hold(chunk_id)?;
        let row = u16::try_from(row).ok()?;
        if is_new {
            self.texels.fill(UNKNOWN_BACKGROUND);
            let read = map.read_chunk(chunk_id, &mut self.file).map(|chunk| {
                let known = chunk.background_width as usize == BACKGROUND_COLUMNS;
                known && chunk.read_background(&mut self.texels) == BACKGROUND_TEXELS
            });
            let written = backend.write_background(row, &self.texels);
            self.backgrounds_missing += u64::from(!(written && matches!(read, Ok(true))));
        }
        Some(row)
    }

    pub(super) fn release_chunk(&mut self, chunk_id: u32) {
        self.chunks.release(chunk_id);
    }
}

fn placement(keyframe: &StoredKeyframe) -> KeyframePlacement {
    KeyframePlacement {
        rotation: rotation_from_xyzw(keyframe.rotation_xyzw),
        translation_m: Vector3::from(keyframe.translation_m),
        scale: keyframe.scale,
    }
}
