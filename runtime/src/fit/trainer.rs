//! The order in which views are inserted and trained.

use super::effort::Clock;
use super::images::TrainingImages;
use super::scene::PosedView;
use super::schedule;
use crate::budget::{Row, Usage};
use crate::map_store::{MapStoreWriter, StoreImage, WriteRefusal, is_held_out_frame};
use crate::mapping::{CHUNK_KEYFRAMES, GivenView, KeyframePacket, Mapper, PacketRefused};
use crate::run_error::RunError;
use crate::splat::{StepSettings, TargetImage};
use kilogs_camera::source::ImageList;
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::conventions::quaternion_xyzw;
use kilogs_core::math::Rng;
use kilogs_core::store::StoredKeyframe;
use kilogs_core::tracking::{KeyframePoint, RoadPlane};
use nalgebra::Point3;
use std::time::{Duration, Instant};

/// Share of the anchor pool at which a section is complete.
const SECTION_FILL: f64 = 0.7;
/// Share of the anchor pool down to which the oldest anchors leave after a section.
const FILL_AFTER_SECTION: f64 = 0.4;
/// One of so many views is revisited.
const REVISIT_STRIDE: usize = 2;
/// Purpose of the draws here (see [`Rng::new`]).
const VIEW_CHOICE: u64 = 0x6669_7476;

/// A view that is trained, and the keyframe that it became.
#[derive(Debug, Clone, Copy)]
struct Active {
    view_idx: usize,
    ordinal: u32,
}

/// Inserts, trains and stores.
pub(super) struct Trainer<'a> {
    pub(super) mapper: Mapper,
    pub(super) store: &'a MapStoreWriter,
    pub(super) images: TrainingImages<ImageList>,
    pub(super) views: &'a [PosedView],
    pub(super) points: &'a [Point3<f64>],
    pub(super) native: Pinhole,
    pub(super) mounting: Option<Mounting>,
    pub(super) step: StepSettings,
    /// Resolution of the insertion relative to the camera's, and of the first steps.
    pub(super) coarse_resolution: f64,
    pub(super) clock: Clock,
    pub(super) usage: &'a Usage,
    /// Most views that are trained together.
    pub(super) max_active: usize,
    /// Points of a view at most.
    pub(super) max_points: usize,
    pub(super) seed: u64,
    pub(super) training: Duration,
    pub(super) n_steps: u64,
    /// Called after every view and every few steps with the progress in [0, 1]; false ends the training.
    pub(super) on_progress: &'a mut dyn FnMut(f64) -> bool,
}

impl Trainer<'_> {
    /// Passes through all views.
    ///
    /// # Errors
    /// [`RunError`] of an image that cannot be read.
    pub(super) fn run(&mut self) -> Result<(), RunError> {
        let mut active: Vec<Active> = Vec::new();
        let (mut ordinal, mut section_begins) = (0, 0.0);
        for view_idx in 0..self.views.len() {
            if is_held_out_frame(view_idx as u64) {
                self.store_view(view_idx, ordinal, true)?;
                continue;
            }
            ordinal = if view_idx == 0 { 0 } else { ordinal + 1 };
            let newest = Active { view_idx, ordinal };
            self.store_view(view_idx, ordinal, false)?;
            self.insert(newest)?;
            active.push(newest);
            let is_full = self.mapper.n_resident_anchors() as f64
                > SECTION_FILL * self.mapper.capacity().anchors as f64
                || active.len() >= self.max_active;
            if is_full {
                let n_kept = (active.len() as f64 * FILL_AFTER_SECTION / SECTION_FILL) as usize;
                let spent = self.clock.progress(self.n_steps);
                let section_ends =
                    schedule::section_ends(spent, (active.len(), n_kept), self.views.len() - view_idx - 1);
                self.train_section(&active, (section_begins, section_ends))?;
                self.store_chunks(&active);
                section_begins = section_ends;
                self.make_room(&mut active);
            }
            if !(self.on_progress)(self.clock.progress(self.n_steps)) {
                return Ok(());
            }
        }
        self.train_section(&active, (section_begins, 1.0))?;
        self.store_chunks(&active);
        Ok(())
    }

    fn insert(&mut self, active: Active) -> Result<(), RunError> {
        let points = self.points_in(active.view_idx);
        let packet = packet(self.views, self.mounting, active, &points, self.images.native(active.view_idx)?);
        match self.mapper.insert_keyframe(&packet, &mut &*self.store) {
            // Rows stay in use when the store has stopped, and it says why when it is finished.
            Ok(_) | Err(PacketRefused::RowInUse { .. }) => {}
            Err(refused) => return Err(RunError::Run(format!("inserting view {}: {refused}", active.view_idx))),
        }
        self.usage.observe(Row::MapNewAnchors, self.mapper.staged_anchors_peak());
        self.usage.observe(Row::MapAnchors, self.mapper.n_resident_anchors() as usize);
        self.usage.observe(Row::MapVoxels, self.mapper.n_resident_anchors() as usize);
        Ok(())
    }

    /// Trains the views whose anchors are in memory until the section's share of the effort is spent.
    fn train_section(&mut self, active: &[Active], (begins, ends): (f64, f64)) -> Result<(), RunError> {
        let inserted_until = self.clock.progress(self.n_steps);
        let begins = begins.max(inserted_until.min(ends));
        let mut rng = Rng::new(self.seed, self.n_steps, VIEW_CHOICE);
        let mut order: Vec<usize> = Vec::with_capacity(active.len());
        let mut next_revisit = 0;
        loop {
            let spent = self.clock.progress(self.n_steps);
            if spent >= ends || active.is_empty() {
                return Ok(());
            }
            let progress = ((spent - begins) / (ends - begins).max(1e-9)).clamp(0.0, 1.0);
            if schedule::REVISITS.get(next_revisit).is_some_and(|at| progress >= *at) {
                next_revisit += 1;
                self.revisit(active, (next_revisit as u32, ends))?;
            }
            let nth = order.pop().unwrap_or_else(|| {
                order.extend(0..active.len());
                shuffle(&mut order, &mut rng);
                order.pop().unwrap_or(0)
            });
            self.train(active[nth], progress)?;
            if self.n_steps.is_multiple_of(8) && !(self.on_progress)(spent) {
                return Ok(());
            }
        }
    }

    fn train(&mut self, active: Active, progress: f64) -> Result<(), RunError> {
        let channels = self.images.channels();
        let (camera, pixels) =
            self.images.at(active.view_idx, schedule::resolution(progress, self.coarse_resolution))?;
        let target = if channels == 1 { TargetImage::Gray8(pixels) } else { TargetImage::Rgb8(pixels) };
        let world_from_camera = self.views[active.view_idx].world_from_camera;
        let given = GivenView { ordinal: active.ordinal, world_from_camera, camera, target };
        let started = Instant::now();
        self.mapper.train_on(&given, &schedule::step(&self.step, progress));
        self.training += started.elapsed();
        self.n_steps += 1;
        self.usage.note_lists(&self.mapper.take_list_load());
        Ok(())
    }

    /// Drops what is faint, then inserts where the trained map is bare or wrong.
    fn revisit(&mut self, active: &[Active], (visit, ends): (u32, f64)) -> Result<(), RunError> {
        for active in active {
            self.mapper.prune_keyframe(active.ordinal);
        }
        for nth in (0..active.len()).step_by(REVISIT_STRIDE) {
            if !self.mapper.holds_keyframe(active[nth].ordinal) {
                // It had to make room: what it would spawn now would belong to no page.
                continue;
            }
            // The views before it tell the depth; the first has only those behind it.
            let n_sources = 2.min(active.len() - 1);
            let sources = if nth >= n_sources { nth - n_sources..nth } else { nth + 1..nth + 1 + n_sources };
            for source in sources.clone() {
                let active = active[source.min(active.len() - 1)];
                let packet = packet(self.views, self.mounting, active, &[], self.images.native(active.view_idx)?);
                self.mapper.look_again(&packet).map_err(|e| RunError::Run(e.to_string()))?;
            }
            let active = active[nth];
            let points = self.points_in(active.view_idx);
            let packet = packet(self.views, self.mounting, active, &points, self.images.native(active.view_idx)?);
            self.mapper.revisit(&packet, (n_sources, visit)).map_err(|e| RunError::Run(e.to_string()))?;
            self.usage.observe(Row::MapNewAnchors, self.mapper.staged_anchors_peak());
            self.usage.observe(Row::MapAnchors, self.mapper.n_resident_anchors() as usize);
            let spent = self.clock.progress(self.n_steps);
            if spent >= ends || !(self.on_progress)(spent) {
                return Ok(());
            }
        }
        Ok(())
    }

    /// The skies of the views that were trained; a store that cannot take them says why when it is finished.
    fn store_chunks(&mut self, active: &[Active]) {
        for nth in 0..active.len() {
            let chunk = |nth: usize| active[nth].ordinal / CHUNK_KEYFRAMES;
            if nth > 0 && chunk(nth) == chunk(nth - 1) {
                continue;
            }
            let active = active[nth];
            if !self.mapper.store_chunk_of(active.ordinal, &mut &*self.store) {
                log::debug!("the sky of keyframe {} was not stored", active.ordinal);
            }
        }
    }

    /// Hands over the oldest anchors, and stops training the views whose anchors are gone.
    fn make_room(&mut self, active: &mut Vec<Active>) {
        let goal = FILL_AFTER_SECTION * self.mapper.capacity().anchors as f64;
        loop {
            let is_crowded = active.len() > self.max_active / 2;
            if !(f64::from(self.mapper.n_resident_anchors()) > goal || is_crowded)
                || !self.mapper.evict_oldest(&mut &*self.store)
            {
                return;
            }
            active.retain(|active| self.mapper.holds_keyframe(active.ordinal));
        }
    }

    /// The scene's points as a view sees them, at most as many as fit.
    fn points_in(&self, view_idx: usize) -> Vec<KeyframePoint> {
        let camera_from_world = self.views[view_idx].world_from_camera.inverse();
        let (width, height) = (f64::from(self.native.width), f64::from(self.native.height));
        let seen = self.points.iter().filter_map(|point| {
            let in_camera = camera_from_world * point;
            let pixel = self.native.project(&in_camera.coords)?;
            let is_inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x < width && pixel.y < height;
            is_inside.then(|| KeyframePoint {
                pixel: [pixel.x as f32, pixel.y as f32],
                depth_m: in_camera.z as f32,
                relative_sigma: POINT_RELATIVE_SIGMA,
            })
        });
        let seen: Vec<KeyframePoint> = seen.collect();
        let every = seen.len().div_ceil(self.max_points.max(1)).max(1);
        seen.into_iter().step_by(every).collect()
    }

    fn store_view(&mut self, view_idx: usize, ordinal: u32, is_held_out: bool) -> Result<(), RunError> {
        let view = &self.views[view_idx];
        let keyframe = StoredKeyframe {
            keyframe_id: ordinal,
            chunk_id: ordinal / CHUNK_KEYFRAMES,
            frame_index: view_idx as u64,
            timestamp_ns: view.timestamp_ns,
            rotation_xyzw: quaternion_xyzw(&view.world_from_camera.rotation),
            translation_m: view.world_from_camera.translation.vector.into(),
            scale: 1.0,
            is_held_out,
            image_bytes: 0,
            image_crc: 0,
        };
        let image = self.images.native(view_idx)?;
        let image = StoreImage { pixels: image.pixels, stride_bytes: image.stride_bytes };
        match self.store.write_keyframe(&keyframe, image) {
            // A stopped store says why when it is finished.
            Ok(()) | Err(WriteRefusal::Busy | WriteRefusal::Stopped) => Ok(()),
            Err(refused @ WriteRefusal::TooLarge) => Err(RunError::Run(format!("storing view {view_idx}: {refused}"))),
        }
    }
}

/// What a point of a point cloud is taken for: a good triangulation.
const POINT_RELATIVE_SIGMA: f32 = 0.02;

/// A view as the mapper takes keyframes.
fn packet<'p>(
    views: &[PosedView],
    mounting: Option<Mounting>,
    active: Active,
    points: &'p [KeyframePoint],
    image: crate::mapping::MappingImage<'p>,
) -> KeyframePacket<'p> {
    let view = &views[active.view_idx];
    KeyframePacket {
        ordinal: active.ordinal,
        frame_index: active.view_idx as u64,
        timestamp_ns: view.timestamp_ns,
        world_from_camera: view.world_from_camera,
        image,
        points,
        road: mounting.map(|mounting| RoadPlane {
            normal_in_camera: mounting.road_normal_in_camera().into(),
            height_m: mounting.height_m,
        }),
    }
}

/// Puts views into an order drawn by `rng`.
pub(crate) fn shuffle<T>(order: &mut [T], rng: &mut Rng) {
    for last in (1..order.len()).rev() {
        order.swap(last, rng.below(last + 1));
    }
}
