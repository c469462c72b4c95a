//! A camera that moves through a stored map.

use super::Picture;
use super::residency::Residency;
use super::selection::{CountedPage, Room, Standpoint, Wanted, pick_pages};
use crate::map_store::{MapStoreReader, StoreError};
use crate::splat::kernel_constants::MAX_IMAGE_SIDE_PX;
use crate::splat::{Overflow, SplatBackend, View};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::{Rigid, rotation_from_xyzw};
use kilogs_core::store::StoredKeyframe;
use nalgebra::{Translation3, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// What was loaded and what was left out while the camera moved.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ViewerCounts {
    /// Pages, or further levels of them, brought into the backend.
    pub pages_loaded: u64,
    /// Pages taken out of it altogether.
    pub pages_evicted: u64,
    /// Pages that cannot be read; they are missing from every picture.
    pub pages_damaged: u64,
    /// Anchors not shown: their keyframe is lost, or the backend refused them.
    pub anchors_left_out: u64,
    /// Chunks shown before grey because their background cannot be read.
    pub backgrounds_missing: u64,
    /// Most anchors that were in the backend at once.
    pub anchors_peak: u64,
    /// What did not fit into single pictures, summed.
    pub overflow: Overflow,
}

/// Keeps what the camera can see in a backend and draws it: of near pages all levels, of far ones the coarse levels.
/// The backend must be empty; it is left with whatever was loaded last.
///
/// Memory: the largest page file, and about 80 bytes per page of the map.
pub struct MapViewer<'a> {
    map: &'a MapStoreReader,
    backend: &'a mut dyn SplatBackend,
    room: Room,
    residency: Residency,
    pages: Vec<CountedPage>,
    lost: BTreeSet<u32>,
    ranked: Vec<(f64, usize)>,
    wanted: Vec<Wanted>,
    counts: ViewerCounts,
}

impl<'a> MapViewer<'a> {
    /// A viewer of `map` through `backend`. Reads the map once, so that what is damaged is known before it is missed.
    pub fn new(map: &'a MapStoreReader, backend: &'a mut dyn SplatBackend) -> Self {
        let capacities = *backend.capacities();
        let mut residency = Residency::new(backend);
        let mut counts = ViewerCounts::default();
        let pages = residency.count_pages(map, &mut |page, problem| {
            log::warn!("page {} is left out of the pictures: {problem}", page.page_id);
            counts.pages_damaged += 1;
        });
        Self {
            map,
            residency,
            backend,
            room: Room::of(&capacities),
            lost: BTreeSet::new(),
            ranked: Vec::with_capacity(pages.len()),
            wanted: Vec::with_capacity(pages.len()),
            pages,
            counts,
        }
    }

    /// What happened so far.
    pub fn counts(&self) -> ViewerCounts {
        ViewerCounts {
            anchors_left_out: self.residency.anchors_left_out,
            backgrounds_missing: self.residency.backgrounds_missing,
            ..self.counts
        }
    }

    /// Draws what `camera` sees from `map_from_camera`, before the sky of `chunk_id`.
    ///
    /// # Errors
    /// The backend's refusal of the view's size or of the chunk, in words.
    pub fn render(
        &mut self,
        map_from_camera: &Rigid,
        camera: &Pinhole,
        chunk_id: u32,
        picture: &mut Picture,
    ) -> Result<(), ViewRefused> {
        self.bring_pages(map_from_camera, chunk_id);
        let chunk_row = self.residency.hold_chunk(self.map, chunk_id, self.backend).ok_or(ViewRefused)?;
        let view = View { camera_from_map: map_from_camera.inverse(), camera: *camera, chunk_row };
        let stats = self.backend.render(&view, picture.target());
        self.residency.release_chunk(chunk_id);
        let overflow = &mut self.counts.overflow;
        overflow.visible_gaussians = overflow.visible_gaussians.saturating_add(stats.overflow.visible_gaussians);
        overflow.row_entries = overflow.row_entries.saturating_add(stats.overflow.row_entries);
        overflow.pairs = overflow.pairs.saturating_add(stats.overflow.pairs);
        if stats.refused { Err(ViewRefused) } else { Ok(()) }
    }

    /// Makes resident what can be seen: first what is not needed goes, then what is missing comes.
    fn bring_pages(&mut self, map_from_camera: &Rigid, chunk_id: u32) {
        let positions_m = &[map_from_camera.translation.vector];
        let standpoint = Standpoint { positions_m, chunk_ids: &[chunk_id], whole_within_m: 0.0 };
        let (pages, room) = (&self.pages, &self.room);
        pick_pages(self.map, pages, &standpoint, room, &mut self.ranked, &mut self.wanted);
        let finest_levels: BTreeMap<u32, u8> =
            self.wanted.iter().map(|wanted| (pages[wanted.page_idx].label.page_id, wanted.finest_level)).collect();
        let evicted = self.residency.evict(self.backend, |page_id| finest_levels.get(&page_id).copied());
        self.counts.pages_evicted += evicted as u64;
        for wanted in &self.wanted {
            let page = &pages[wanted.page_idx].label;
            if self.residency.holds(page.page_id, wanted.finest_level) || self.lost.contains(&page.page_id) {
                continue;
            }
            match self.residency.load(self.map, page, wanted.finest_level, self.backend) {
                Ok(loaded) => self.counts.pages_loaded += u64::from(loaded),
                Err(problem) => {
                    log::warn!("page {} was lost while the camera moved: {problem}", page.page_id);
                    self.lost.insert(page.page_id);
                    self.counts.pages_damaged += 1;
                }
            }
        }
        self.counts.anchors_peak = self.counts.anchors_peak.max(self.residency.n_anchors() as u64);
    }

    /// Chunk of the keyframe nearest to a place: the sky to draw when nothing else says which.
    pub fn chunk_near(&self, position_in_map_m: &Vector3<f64>) -> u32 {
        let distance_m = |k: &StoredKeyframe| (Vector3::from(k.translation_m) - position_in_map_m).norm();
        let nearest = self.map.keyframes().iter().min_by(|a, b| distance_m(a).total_cmp(&distance_m(b)));
        nearest.map_or(0, |keyframe| keyframe.chunk_id)
    }
}

/// Where the camera of a stored view was; a similarity's scale moves nothing in its own picture.
pub(crate) fn map_from_camera(keyframe: &StoredKeyframe) -> Rigid {
    let [x, y, z] = keyframe.translation_m;
    Rigid::from_parts(Translation3::new(x, y, z), rotation_from_xyzw(keyframe.rotation_xyzw))
}

/// The backend cannot draw pictures of this size or of this chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the splat backend refuses pictures of this size; use images of at most {MAX_IMAGE_SIDE_PX} px a side")]
pub struct ViewRefused;

/// Why no pictures could be made.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The map could not be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The backend cannot draw pictures of the map's size.
    #[error("drawing a view of {width} x {height} px: {source}")]
    Refused {
        /// Width of the picture, px.
        width: u32,
        /// Height of the picture, px.
        height: u32,
        /// The refusal.
        source: ViewRefused,
    },
    /// The trajectory could not be read.
    #[error(transparent)]
    Trajectory(#[from] kilogs_eval::command::EvalError),
    /// The network that compares pictures failed.
    #[error(transparent)]
    Network(#[from] crate::inference::ModelError),
    /// A table of views could not be written.
    #[error(transparent)]
    Table(#[from] crate::output::OutputError),
    /// A picture could not be written.
    #[error("writing {path}: {reason}; check that the folder can be written and has room")]
    Write {
        /// The file or folder.
        path: std::path::PathBuf,
        /// Why.
        reason: String,
    },
}

impl RenderError {
    /// The exit code of contracts.md.
    pub fn code(&self) -> u8 {
        match self {
            Self::Store(_) => StoreError::EXIT_CODE,
            Self::Refused { .. } => 2,
            Self::Trajectory(_) => 3,
            Self::Network(_) | Self::Table(_) | Self::Write { .. } => 1,
        }
    }
}
