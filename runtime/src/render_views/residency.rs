//! The pages that are in the backend, and what they hold there.

use super::selection::CountedPage;
use crate::map_store::{MapStoreReader, StoreError};
use crate::splat::{
    AnchorHeader, BACKGROUND_COLUMNS, BACKGROUND_TEXELS, DecoderShape, GaussianParams, KeyframePlacement, RowTable,
    SplatBackend,
};
use kilogs_core::conventions::rotation_from_xyzw;
use kilogs_core::map::lod::N_LEVELS;
use kilogs_core::store::{PageLabel, StoredAnchor, StoredKeyframe};
use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet};

/// Color of a direction whose chunk is lost.
const UNKNOWN_BACKGROUND: [f32; 3] = [0.5; 3];

/// A page in the backend, with all its levels from the finest.
#[derive(Debug)]
struct ResidentPage {
    label: PageLabel,
    finest_level: u8,
    slots: [Vec<u32>; N_LEVELS],
    /// Some anchor of it was not shown.
    has_left_out: bool,
}

/// Book of slots and rows; the backend itself is handed in.
#[derive(Debug)]
pub(crate) struct Residency {
    pages: BTreeMap<u32, ResidentPage>,
    free_slots: Vec<u32>,
    keyframes: RowTable,
    chunks: RowTable,
    file: Vec<u8>,
    gaussians: Vec<GaussianParams>,
    texels: Vec<[f32; 3]>,
    /// Decoder on its way; empty when the backend draws what is stored.
    decoder: Vec<f32>,
    /// Anchors that were not shown: their keyframe is lost or the backend refused them.
    pub(crate) anchors_left_out: u64,
    /// Chunks without a readable background.
    pub(crate) backgrounds_missing: u64,
}

impl Residency {
    pub(crate) fn new(backend: &dyn SplatBackend) -> Self {
        let capacities = backend.capacities();
        let unused = GaussianParams {
            offset: [0.0; 3],
            log_scale: [0.0; 3],
            quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
            opacity_logit: 0.0,
            color_logit: [0.0; 3],
        };
        let shape = DecoderShape::new(capacities.gaussians_per_anchor);
        let decoder_len = if capacities.learned_decoder { shape.len() } else { 0 };
        Self {
            pages: BTreeMap::new(),
            free_slots: (0..u32::try_from(capacities.anchors).unwrap_or(u32::MAX)).rev().collect(),
            keyframes: RowTable::new(capacities.keyframe_rows),
            chunks: RowTable::new(capacities.chunk_rows.min(usize::from(u16::MAX))),
            file: Vec::new(),
            gaussians: vec![unused; capacities.gaussians_per_anchor],
            texels: vec![UNKNOWN_BACKGROUND; BACKGROUND_TEXELS],
            decoder: vec![0.0; decoder_len],
            anchors_left_out: 0,
            backgrounds_missing: 0,
        }
    }

    /// Whether a page is resident with `finest_level` and all coarser ones.
    pub(crate) fn holds(&self, page_id: u32, finest_level: u8) -> bool {
        self.pages.get(&page_id).is_some_and(|page| page.finest_level <= finest_level)
    }

    pub(crate) fn n_anchors(&self) -> usize {
        self.pages.values().flat_map(|page| &page.slots).map(Vec::len).sum()
    }

    /// Pages whose every anchor is in the backend, by id, with the slots of each level.
    pub(crate) fn whole_pages(&self) -> impl Iterator<Item = (&PageLabel, &[Vec<u32>])> {
        let is_whole = |page: &&ResidentPage| page.finest_level == 0 && !page.has_left_out;
        self.pages.values().filter(is_whole).map(|page| (&page.label, page.slots.as_slice()))
    }

    /// Pages of which some anchors are not in the backend although their levels are.
    pub(crate) fn incomplete_pages(&self) -> impl Iterator<Item = &PageLabel> {
        self.pages.values().filter(|page| page.has_left_out).map(|page| &page.label)
    }

    /// Ends anchors of resident pages before their time.
    pub(crate) fn retire(&mut self, backend: &mut dyn SplatBackend, ended: &BTreeSet<u32>) {
        for levels in self.pages.values_mut().flat_map(|page| &mut page.slots) {
            let leaving = levels.extract_if(.., |slot| ended.contains(slot));
            let leaving: Vec<u32> = leaving.collect();
            backend.retire_anchors(&leaving);
            self.free_slots.extend(leaving);
        }
    }

    /// Keyframe whose anchors refer to a row.
    pub(crate) fn keyframe_in_row(&self, row: u32) -> Option<u32> {
        self.keyframes.id_in_row(row)
    }

    /// Takes out what is not wanted: `finest_level` says from which level on a page stays, `None` not at all.
    /// Returns how many pages left altogether.
    pub(crate) fn evict(&mut self, backend: &mut dyn SplatBackend, finest_level: impl Fn(u32) -> Option<u8>) -> usize {
        let mut leaving = Vec::new();
        for (page_id, page) in &mut self.pages {
            let Some(finest_level) = finest_level(*page_id) else {
                leaving.push(*page_id);
                continue;
            };
            for slots in page.slots.iter_mut().take(usize::from(finest_level)) {
                backend.retire_anchors(slots);
                self.free_slots.append(slots);
            }
            page.finest_level = page.finest_level.max(finest_level);
        }
        for page_id in &leaving {
            if let Some(page) = self.pages.remove(page_id) {
                self.forget(page, backend);
            }
        }
        leaving.len()
    }

    fn forget(&mut self, page: ResidentPage, backend: &mut dyn SplatBackend) {
        for mut slots in page.slots {
            backend.retire_anchors(&slots);
            self.free_slots.append(&mut slots);
        }
        for id in page.label.first_keyframe_id..=page.label.last_keyframe_id {
            self.keyframes.release(id);
        }
        self.chunks.release(page.label.chunk_id);
    }

    /// Puts a page into the backend with all levels from `finest_level`, or the levels of it that are not there yet.
    /// False when there is no room.
    ///
    /// # Errors
    /// [`StoreError`] when the page is damaged: nothing of it is shown.
    pub(crate) fn load(
        &mut self,
        map: &MapStoreReader,
        page: &PageLabel,
        finest_level: u8,
        backend: &mut dyn SplatBackend,
    ) -> Result<bool, StoreError> {
        let mut resident = match self.pages.remove(&page.page_id) {
            Some(resident) => resident,
            None => match self.admit(map, page, backend) {
                Some(resident) => resident,
                None => return Ok(false),
            },
        };
        match self.load_anchors(map, finest_level, &mut resident, backend) {
            Ok(()) => {
                self.pages.insert(page.page_id, resident);
                Ok(true)
            }
            Err(problem) => {
                self.forget(resident, backend);
                Err(problem)
            }
        }
    }

    /// Rows for a page that is not resident, still without anchors; `None` when the tables are full.
    fn admit(
        &mut self,
        map: &MapStoreReader,
        page: &PageLabel,
        backend: &mut dyn SplatBackend,
    ) -> Option<ResidentPage> {
        self.hold_chunk(map, page.chunk_id, backend)?;
        if !self.hold_keyframes(map, page, backend) {
            self.chunks.release(page.chunk_id);
            return None;
        }
        Some(ResidentPage {
            label: *page,
            finest_level: N_LEVELS as u8,
            slots: Default::default(),
            has_left_out: false,
        })
    }

    fn load_anchors(
        &mut self,
        map: &MapStoreReader,
        finest_level: u8,
        resident: &mut ResidentPage,
        backend: &mut dyn SplatBackend,
    ) -> Result<(), StoreError> {
        let missing = finest_level..resident.finest_level;
        let chunk_row = self.chunks.row(resident.label.chunk_id).and_then(|row| u16::try_from(row).ok()).unwrap_or(0);
        let (label, mut anchors) = map.read_page(resident.label.page_id, &mut self.file)?;
        resident.label = label;
        while let Some((anchor, feature)) = anchors.next_with_feature(&mut self.gaussians) {
            let level = level_of(&anchor);
            if !missing.contains(&level) {
                continue;
            }
            // A keyframe that the log lost has no row that was filled for it.
            let row = self.keyframes.row(anchor.keyframe_id).filter(|_| map.keyframe(anchor.keyframe_id).is_some());
            let fits = usize::from(anchor.n_gaussians) <= self.gaussians.len();
            let (Some(row), true, Some(slot)) = (row, fits, self.free_slots.pop()) else {
                self.anchors_left_out += 1;
                resident.has_left_out = true;
                continue;
            };
            let header: AnchorHeader = anchor.to_header(row, chunk_row);
            let mut refused = backend.write_anchors(&[slot], &[header], &self.gaussians);
            if refused == 0 && !self.decoder.is_empty() {
                refused = backend.write_features(&[slot], &[feature]);
            }
            match resident.slots.get_mut(usize::from(level)) {
                Some(slots) if refused == 0 => slots.push(slot),
                _ => {
                    self.anchors_left_out += 1;
                    resident.has_left_out = true;
                    self.free_slots.push(slot);
                }
            }
        }
        resident.finest_level = resident.finest_level.min(finest_level);
        Ok(())
    }

    /// Reads every page once: how many anchors of each level it has, in the order of the map. What is damaged is
    /// left out and handed to `damaged`.
    pub(crate) fn count_pages(
        &mut self,
        map: &MapStoreReader,
        damaged: &mut dyn FnMut(&PageLabel, &StoreError),
    ) -> Vec<CountedPage> {
        let mut counted = Vec::with_capacity(map.pages().len());
        for page in map.pages() {
            match map.read_page(page.page_id, &mut self.file) {
                Ok((_, mut anchors)) => {
                    let mut n_anchors = [0; N_LEVELS];
                    while let Some(anchor) = anchors.next_anchor(&mut []) {
                        if let Some(n) = n_anchors.get_mut(usize::from(level_of(&anchor))) {
                            *n += 1;
                        }
                    }
                    counted.push(CountedPage { label: *page, n_anchors });
                }
                Err(problem) => damaged(page, &problem),
            }
        }
        counted
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
    pub(crate) fn hold_chunk(
        &mut self,
        map: &MapStoreReader,
        chunk_id: u32,
        backend: &mut dyn SplatBackend,
    ) -> Option<u16> {
        let (row, is_new) = self.chunks.hold(chunk_id)?;
        let row = u16::try_from(row).ok()?;
        if is_new {
            self.texels.fill(UNKNOWN_BACKGROUND);
            // A chunk that is lost adds nothing to what its anchors store.
            self.decoder.fill(0.0);
            let read = map.read_chunk(chunk_id, &mut self.file).map(|chunk| {
                chunk.decoder.read_residual(&mut self.decoder);
                let known = chunk.background_width as usize == BACKGROUND_COLUMNS;
                known && chunk.read_background(&mut self.texels) == BACKGROUND_TEXELS
            });
            if !self.decoder.is_empty() {
                backend.write_decoder(row, &self.decoder);
            }
            let written = backend.write_background(row, &self.texels);
            self.backgrounds_missing += u64::from(!(written && matches!(read, Ok(true))));
        }
        Some(row)
    }

    pub(crate) fn release_chunk(&mut self, chunk_id: u32) {
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

/// Level of an anchor; one that does not exist is never drawn and kept with the coarsest.
fn level_of(anchor: &StoredAnchor) -> u8 {
    anchor.level.min(N_LEVELS as u8 - 1)
}
