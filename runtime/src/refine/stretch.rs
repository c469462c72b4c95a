//! What of the map is in memory while a stretch of the route is trained: how it comes, and how it is stored again.

use super::guests::guests;
use crate::map_store::{MapStoreEditor, MapStoreReader, StoreError};
use crate::mapping::{NO_GAUSSIAN, NO_HEADER};
use crate::render_views::{CountedPage, Residency, Room, Standpoint, Wanted, map_from_camera, pick_pages};
use crate::splat::{
    AnchorFeature, AnchorHeader, BACKGROUND_COLUMNS, BACKGROUND_TEXELS, DecoderShape, GaussianParams, SplatBackend,
};
use kilogs_core::map::decoder::{NO_FEATURE, residual_at_spawn};
use kilogs_core::map::lod::N_LEVELS;
use kilogs_core::map::quota::RouteMeasure;
use kilogs_core::store::{ChunkBackground, ChunkLabel, DecoderParams, PageLabel, StoredAnchor, StoredKeyframe};
use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::{Range, RangeInclusive};

/// Pages with a keyframe so near to one of the stretch are loaded with all levels, and stored again, m: what the finest
/// level is seen from, and some more for bends.
const WHOLE_WITHIN_M: f64 = 30.0;
/// Anchors that are read from the backend at once.
pub(super) const READ_ANCHORS: usize = 1024;

/// The map through a backend, a stretch at a time.
pub(super) struct StretchMemory<'a> {
    map: &'a MapStoreReader,
    backend: &'a mut dyn SplatBackend,
    residency: Residency,
    pages: Vec<CountedPage>,
    editor: MapStoreEditor,
    room: Room,
    /// Rows of the chunks that the stretch's views belong to.
    chunk_rows: BTreeMap<u32, u16>,
    scratch: Scratch,
    losses: Losses,
}

/// What could not be improved.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Losses {
    /// Pages that cannot be read.
    pub(super) damaged_pages: BTreeSet<u32>,
    /// Pages with anchors that found no room or have no keyframe: left as they are.
    pub(super) unstored_pages: BTreeSet<u32>,
    /// Chunks that cannot be read.
    pub(super) damaged_chunks: BTreeSet<u32>,
}

/// Anchors as the backend holds them.
pub(super) struct StagedAnchors {
    pub(super) headers: Vec<AnchorHeader>,
    /// As many per anchor as one can have.
    pub(super) params: Vec<GaussianParams>,
    pub(super) features: Vec<AnchorFeature>,
}

impl StagedAnchors {
    fn new(n: usize, gaussians_per_anchor: usize) -> Self {
        Self {
            headers: vec![NO_HEADER; n],
            params: vec![NO_GAUSSIAN; n * gaussians_per_anchor],
            features: vec![NO_FEATURE; n],
        }
    }

    fn read(&mut self, backend: &dyn SplatBackend, slots: &[u32], gaussians_per_anchor: usize) {
        let n = slots.len();
        backend.read_anchors(slots, &mut self.headers[..n], &mut self.params[..n * gaussians_per_anchor]);
        // Features stay 0 where the backend has none.
        backend.read_features(slots, &mut self.features[..n]);
    }
}

/// Anchors and chunks on their way out of the backend.
struct Scratch {
    anchors: StagedAnchors,
    texels: Vec<[f32; 3]>,
    /// Empty when nothing is learned.
    decoder: Vec<f32>,
    /// Row of the chunk that `decoder` is known to be of.
    decoder_row: Option<u16>,
    residual: Vec<f32>,
    file: Vec<u8>,
    ranked: Vec<(f64, usize)>,
    wanted: Vec<Wanted>,
}

impl<'a> StretchMemory<'a> {
    /// Reads the map once. The backend must be empty.
    pub(super) fn new(map: &'a MapStoreReader, backend: &'a mut dyn SplatBackend, editor: MapStoreEditor) -> Self {
        let capacities = *backend.capacities();
        let k = capacities.gaussians_per_anchor;
        let mut residency = Residency::new(backend);
        let mut losses = Losses::default();
        let pages = residency.count_pages(map, &mut |page, problem| {
            log::warn!("page {} is left as it is: {problem}", page.page_id);
            losses.damaged_pages.insert(page.page_id);
        });
        let decoder_len = if capacities.learned_decoder { DecoderShape::new(k).len() } else { 0 };
        let scratch = Scratch {
            anchors: StagedAnchors::new(READ_ANCHORS, k),
            texels: vec![[0.0; 3]; BACKGROUND_TEXELS],
            decoder: vec![0.0; decoder_len],
            decoder_row: None,
            residual: Vec::new(),
            file: Vec::new(),
            ranked: Vec::with_capacity(pages.len()),
            wanted: Vec::with_capacity(pages.len()),
        };
        let room = Room::of(&capacities);
        Self { map, backend, residency, pages, editor, room, chunk_rows: BTreeMap::new(), scratch, losses }
    }

    pub(super) fn backend(&mut self) -> &mut dyn SplatBackend {
        self.backend
    }

    pub(super) fn losses(&self) -> &Losses {
        &self.losses
    }

    /// Ends the work on the map.
    pub(super) fn into_editor(self) -> MapStoreEditor {
        self.editor
    }

    /// Row of the chunk of a view in the stretch.
    pub(super) fn chunk_row(&self, chunk_id: u32) -> Option<u16> {
        self.chunk_rows.get(&chunk_id).copied()
    }

    /// Slots of the whole pages whose keyframes begin in `keyframe_ids`.
    pub(super) fn own_slots(&self, keyframe_ids: &RangeInclusive<u32>) -> Vec<u32> {
        let own = self.residency.whole_pages().filter(|(label, _)| keyframe_ids.contains(&label.first_keyframe_id));
        own.flat_map(|(_, levels)| levels.iter().flatten().copied()).collect()
    }

    /// Metres of route along which the anchors of those pages were spawned: to the next keyframe each, and the first view.
    pub(super) fn own_length_m(&self, keyframe_ids: &RangeInclusive<u32>, measure: &RouteMeasure) -> f64 {
        let own = self.residency.whole_pages().filter(|(label, _)| keyframe_ids.contains(&label.first_keyframe_id));
        let own: Vec<RangeInclusive<u32>> =
            own.map(|(label, _)| label.first_keyframe_id..=label.last_keyframe_id).collect();
        let is_own = |keyframe: &StoredKeyframe| own.iter().any(|ids| ids.contains(&keyframe.keyframe_id));
        let keyframes = self.map.keyframes();
        let own_steps = keyframes.windows(2).filter(|step| is_own(&step[0]));
        let way_m: f64 =
            own_steps.map(|step| measure.step_m(&map_from_camera(&step[0]), &map_from_camera(&step[1]))).sum();
        if keyframes.first().is_some_and(is_own) { way_m + measure.first_view_m } else { way_m }
    }

    /// What the backend holds in some slots.
    pub(super) fn read(&self, slots: &[u32]) -> StagedAnchors {
        let k = self.backend.capacities().gaussians_per_anchor;
        let mut staged = StagedAnchors::new(slots.len(), k);
        staged.read(self.backend, slots, k);
        staged
    }

    /// What a chunk's decoder adds to an anchor seen from the keyframe that spawned it; empty where nothing is learned.
    pub(super) fn residual_at_spawn(&mut self, header: &AnchorHeader, feature: &AnchorFeature) -> &[f32] {
        let Scratch { decoder, decoder_row, residual, .. } = &mut self.scratch;
        if decoder.is_empty() {
            return &[];
        }
        if decoder_row.replace(header.chunk_row) != Some(header.chunk_row) {
            self.backend.read_decoder(header.chunk_row, decoder);
        }
        let shape = DecoderShape::new(self.backend.capacities().gaussians_per_anchor);
        residual.resize(shape.outputs, 0.0);
        residual_at_spawn(shape, decoder, feature, header.position_in_keyframe_m, residual);
        residual
    }

    /// Ends anchors.
    pub(super) fn retire(&mut self, slots: &BTreeSet<u32>) {
        self.residency.retire(self.backend, slots);
        // The next decoder that is asked for has been trained on.
        self.scratch.decoder_row = None;
    }

    /// The longest stretches, up to `longest` keyframes, whose own pages fit into the backend wherever they begin.
    pub(super) fn longest_stretch(&mut self, longest: usize) -> usize {
        let n = self.map.keyframes().len();
        let mut length = longest;
        while length > 1 {
            let step = (length / 2).max(1);
            let all_fit = (0..n).step_by(step).all(|first| {
                let keyframes = first..(first + length).min(n);
                self.pick(keyframes.clone());
                self.holds_own_pages(&keyframes)
            });
            if all_fit {
                break;
            }
            length /= 2;
        }
        length
    }

    fn pick(&mut self, keyframes: Range<usize>) {
        let own = &self.map.keyframes()[keyframes];
        let positions_m: Vec<Vector3<f64>> = own.iter().map(|k| Vector3::from(k.translation_m)).collect();
        let chunk_ids: BTreeSet<u32> = own.iter().map(|keyframe| keyframe.chunk_id).collect();
        let chunk_ids: Vec<u32> = chunk_ids.into_iter().collect();
        let standpoint =
            Standpoint { positions_m: &positions_m, chunk_ids: &chunk_ids, whole_within_m: WHOLE_WITHIN_M };
        let Scratch { ranked, wanted, .. } = &mut self.scratch;
        pick_pages(self.map, &self.pages, &standpoint, &self.room, ranked, wanted);
    }

    /// Whether everything that was spawned by `keyframes` was picked.
    fn holds_own_pages(&self, keyframes: &Range<usize>) -> bool {
        let own = &self.map.keyframes()[keyframes.clone()];
        let (Some(first), Some(last)) = (own.first(), own.last()) else { return true };
        let picked: BTreeSet<usize> = self.scratch.wanted.iter().map(|wanted| wanted.page_idx).collect();
        self.pages.iter().enumerate().all(|(idx, CountedPage { label, n_anchors })| {
            let is_own = label.first_keyframe_id <= last.keyframe_id && label.last_keyframe_id >= first.keyframe_id;
            !is_own || n_anchors.iter().sum::<u32>() == 0 || picked.contains(&idx)
        })
    }

    /// Brings what the views of these keyframes see into the backend. Returns what is to be trained then: they and, behind
    /// them, who looks at the same.
    pub(super) fn load(&mut self, keyframes: Range<usize>) -> Vec<usize> {
        self.pick(keyframes.clone());
        let mut views: Vec<usize> = keyframes.clone().collect();
        views.extend(guests(self.map.keyframes(), &keyframes, WHOLE_WITHIN_M));
        for keyframe in views.iter().map(|&view| &self.map.keyframes()[view]) {
            if !self.chunk_rows.contains_key(&keyframe.chunk_id)
                && let Some(row) = self.residency.hold_chunk(self.map, keyframe.chunk_id, self.backend)
            {
                self.chunk_rows.insert(keyframe.chunk_id, row);
            }
        }
        for nth in 0..self.scratch.wanted.len() {
            let wanted = self.scratch.wanted[nth];
            let page = self.pages[wanted.page_idx];
            // A page without finer anchors is whole from its finest ones on.
            let is_whole = page.n_anchors.iter().take(usize::from(wanted.finest_level)).all(|n| *n == 0);
            let finest_level = if is_whole { 0 } else { wanted.finest_level };
            if let Err(problem) = self.residency.load(self.map, &page.label, finest_level, self.backend) {
                log::warn!("page {} was lost meanwhile: {problem}", page.label.page_id);
                self.losses.damaged_pages.insert(page.label.page_id);
            }
        }
        self.losses.unstored_pages.extend(self.residency.incomplete_pages().map(|label| label.page_id));
        let has_row = |view: &usize| self.chunk_rows.contains_key(&self.map.keyframes()[*view].chunk_id);
        views.retain(|view| keyframes.contains(view) || has_row(view));
        views
    }

    /// Stores every page that is in the backend as a whole, and the chunks of the stretch's views; then empties the
    /// backend. Pages that are there for their coarse levels only have seen too little of what they are for: what was
    /// trained of them is dropped.
    ///
    /// # Errors
    /// [`StoreError`] when the disk is full or gone; what was stored before is whole.
    pub(super) fn store_and_clear(&mut self) -> Result<(), StoreError> {
        let Self { map, backend, residency, pages, editor, chunk_rows, scratch, losses, .. } = self;
        for (label, levels) in residency.whole_pages() {
            let label = PageLabel { revision: label.revision.saturating_add(1), ..*label };
            let written = store_page(editor, label, levels, *backend, residency, scratch)?;
            if let Some(counted) = pages.iter_mut().find(|counted| counted.label.page_id == written.page_id) {
                *counted = CountedPage { label: written, n_anchors: counts(levels) };
            }
        }
        for (chunk_id, row) in std::mem::take(chunk_rows) {
            if !store_chunk(editor, map, (chunk_id, row), *backend, scratch)? {
                losses.damaged_chunks.insert(chunk_id);
            }
            residency.release_chunk(chunk_id);
        }
        residency.evict(*backend, |_| None);
        Ok(())
    }
}

fn counts(levels: &[Vec<u32>]) -> [u32; N_LEVELS] {
    let mut n_anchors = [0; N_LEVELS];
    n_anchors.iter_mut().zip(levels).for_each(|(n, slots)| *n = slots.len() as u32);
    n_anchors
}

fn store_page(
    editor: &mut MapStoreEditor,
    label: PageLabel,
    levels: &[Vec<u32>],
    backend: &dyn SplatBackend,
    residency: &Residency,
    scratch: &mut Scratch,
) -> Result<PageLabel, StoreError> {
    let k = backend.capacities().gaussians_per_anchor;
    let staged = &mut scratch.anchors;
    editor.replace_page(label, |page| {
        for slots in levels.iter().flat_map(|slots| slots.chunks(READ_ANCHORS)) {
            staged.read(backend, slots, k);
            let read = staged.headers.iter().zip(&staged.features).zip(staged.params.chunks_exact(k));
            for ((header, feature), gaussians) in read.take(slots.len()) {
                // The row is held by the page's own keyframe.
                let Some(keyframe_id) = residency.keyframe_in_row(header.keyframe_row) else { continue };
                page.push_with_feature(&StoredAnchor::from_header(header, keyframe_id), feature, gaussians)?;
            }
        }
        Ok(())
    })
}

/// False when the chunk on disk cannot be read: it stays as it is.
fn store_chunk(
    editor: &mut MapStoreEditor,
    map: &MapStoreReader,
    (chunk_id, row): (u32, u16),
    backend: &dyn SplatBackend,
    scratch: &mut Scratch,
) -> Result<bool, StoreError> {
    let Ok(stored) = map.read_chunk(chunk_id, &mut scratch.file) else { return Ok(false) };
    let label = ChunkLabel { revision: stored.label.revision.saturating_add(1), ..stored.label };
    let decoder = match backend.read_decoder(row, &mut scratch.decoder) {
        true => DecoderParams::residual(&scratch.decoder),
        false => DecoderParams::EXPLICIT,
    };
    backend.read_background(row, &mut scratch.texels);
    let background = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &scratch.texels };
    editor.replace_chunk(&label, decoder, background).map(|()| true)
}
