//! The mapping thread: keyframes in, training steps in the time left, pages and images to the store.

use super::loops::SharedAlignment;
use super::mapper_link::{Job, MapperLink};
use super::memory;
use super::plan::{Pace, RunPlan};
use super::queue::{Received, Receiver, Sender};
use super::resume::Resume;
use super::tracking_thread::milliseconds;
use crate::budget::{Row, Usage};
use crate::map_store::{MapStoreReader, MapStoreWriter, PictureRule, StoreImage, StoreSummary, WriteRefusal};
use crate::mapping::{CHUNK_KEYFRAMES, KeyframePacket, MapCounters, Mapper, MappingImage};
use crate::output::Stage;
use crate::run_error::RunError;
use crate::seal;
use kilogs_core::conventions::{Rigid, Similarity, quaternion_xyzw};
use kilogs_core::frame::PixelFormat;
use kilogs_core::store::StoredKeyframe;
use kilogs_core::tracking::FrameReport;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

/// Live, so many steps per keyframe are enough: a standing vehicle does not train for ever on what it sees.
const MAX_LIVE_ITERATIONS: u32 = 150;
/// How long the thread sleeps when there is nothing to train.
const IDLE_INTERVAL: Duration = Duration::from_millis(100);
/// Jobs after which nothing is set up any more and the thread is sealed.
const WARM_UP_JOBS: u64 = 3;

/// The mapping thread's end, and everything it owns.
pub struct MappingWork {
    mapper: Mapper,
    store: MapStoreWriter,
    jobs: Receiver<Box<Job>>,
    free: Sender<Box<Job>>,
    pace: Pace,
    map_format: PixelFormat,
    row_bytes: usize,
    usage: Arc<Usage>,
    progress: Arc<MappingProgress>,
    /// Views that the finished map can be opened with.
    max_views: usize,
    n_views: usize,
    pictures: PictureRule,
    n_images_left_out: u64,
    n_views_refused: u64,
    has_warned_of_steps: bool,
    training: Duration,
    resume: Option<Resume>,
    alignment: SharedAlignment,
}

/// How far mapping is, for whoever looks while it goes on.
#[derive(Debug, Default)]
pub struct MappingProgress {
    /// Anchors in memory.
    pub anchors_resident: AtomicU64,
    /// Training steps so far.
    pub iterations: AtomicU64,
    /// Files of the map store so far, bytes.
    pub store_bytes: AtomicU64,
}

/// What mapping did.
#[derive(Debug, Clone, Copy)]
pub struct MappingSummary {
    /// Counts of the mapper.
    pub counters: MapCounters,
    /// Anchors in memory when the drive ended.
    pub anchors_resident: u64,
    /// The finished store.
    pub store: StoreSummary,
    /// Time spent on training steps.
    pub training: Duration,
    /// Keyframe images that found the store's queue full.
    pub n_images_left_out: u64,
    /// Views that the mapper or the store could not use.
    pub n_views_refused: u64,
}

/// Takes all memory of mapping; `None` when mapping is switched off.
///
/// # Errors
/// [`RunError`] when the backend or the map folder cannot be set up.
pub fn prepare(
    plan: &RunPlan,
    usage: &Arc<Usage>,
    progress: &Arc<MappingProgress>,
    alignment: &SharedAlignment,
) -> Result<Option<(MapperLink, MappingWork)>, RunError> {
    if !plan.settings.mapping.enabled {
        let of_before = plan.out.join("map");
        if of_before.exists() {
            log::warn!("mapping is off: {} is of an earlier run and is left as it is", of_before.display());
        }
        return Ok(None);
    }
    let mut mapper = memory::mapper(plan)?;
    let max_views = plan.budget.capacity(Row::StoreKeyframeTable);
    let (manifest, settings) = (memory::manifest(plan), memory::store_settings(plan));
    let mut pictures = PictureRule::new(max_views);
    let (store, n_views) = match &plan.resume {
        None => (MapStoreWriter::create(&plan.map_folder(), &manifest, &settings)?, 0),
        Some(resume) => {
            let map = MapStoreReader::open(&resume.map, max_views)?;
            let store = MapStoreWriter::resume(&map, &manifest, &settings)?;
            mapper.resume(&map, &alignment.lock());
            let views = || map.keyframes().iter().chain(map.held_out());
            views().filter(|view| view.image_bytes > 0).for_each(|view| pictures.remember(view));
            (store, views().count())
        }
    };
    let (link, (jobs, free)) = MapperLink::new(plan, usage);
    let work = MappingWork {
        mapper,
        store,
        jobs,
        free,
        pace: plan.pace,
        map_format: plan.pixel_format,
        row_bytes: plan.pixel_format.row_bytes(plan.camera.width) as usize,
        usage: Arc::clone(usage),
        progress: Arc::clone(progress),
        max_views,
        n_views,
        pictures,
        n_images_left_out: 0,
        n_views_refused: 0,
        has_warned_of_steps: false,
        training: Duration::ZERO,
        resume: plan.resume.clone(),
        alignment: alignment.clone(),
    };
    Ok(Some((link, work)))
}

impl MappingWork {
    /// Maps until the tracking thread is done, then hands over all that is left and finishes the store.
    ///
    /// # Errors
    /// [`RunError::Store`] when the map could not be written.
    pub fn run(mut self) -> Result<MappingSummary, RunError> {
        let mut sealed = None;
        let mut n_jobs = 0_u64;
        let mut n_live_iterations = MAX_LIVE_ITERATIONS;
        loop {
            self.progress.store_bytes.store(self.store.bytes_on_disk(), Ordering::Relaxed);
            let has_spare_work = self.pace == Pace::Live && n_live_iterations < MAX_LIVE_ITERATIONS;
            let patience = if has_spare_work { Duration::ZERO } else { IDLE_INTERVAL };
            match self.jobs.pop_within(patience) {
                Received::Element(mut job) => {
                    if self.job(&mut job) {
                        n_live_iterations = 0;
                    }
                    n_jobs += 1;
                    // The tracking thread is gone only when the run ends: nobody misses the job then.
                    let _ = self.free.push(job);
                    if sealed.is_none() && n_jobs >= WARM_UP_JOBS {
                        sealed = Some(seal::enter());
                    }
                }
                Received::Empty if has_spare_work => {
                    n_live_iterations += 1;
                    self.train(1);
                }
                Received::Empty => {}
                Received::Closed => break,
            }
        }
        drop(sealed);
        self.finish()
    }

    /// One keyframe or held-out view; whether the map learnt from it.
    fn job(&mut self, job: &mut Job) -> bool {
        let Some(unaligned) = job.report else { return false };
        let unaligned = self.resume.as_ref().map_or(unaligned, |resume| resume.in_map(&unaligned));
        let started = Instant::now();
        if !job.is_held_out {
            self.realign();
        }
        let report = self.align(&unaligned, job);
        job.times.add(Stage::Insertion, milliseconds(started.elapsed()));
        let started = Instant::now();
        self.store_view(job, &unaligned, &report.world_from_camera);
        job.times.add(Stage::Store, milliseconds(started.elapsed()));
        if job.is_held_out {
            return false;
        }
        let started = Instant::now();
        let packet = KeyframePacket {
            ordinal: report.keyframe_ordinal,
            frame_index: report.frame_index,
            timestamp_ns: report.timestamp_ns,
            world_from_camera: report.world_from_camera,
            image: MappingImage { pixels: &job.pixels, stride_bytes: self.row_bytes, format: self.map_format },
            points: &job.points,
            road: job.road,
        };
        self.mapper.bring_pages(&packet, &mut &self.store);
        if let Err(refused) = self.mapper.insert_keyframe(&packet, &mut &self.store) {
            self.refuse(&refused);
            return false;
        }
        job.times.add(Stage::Insertion, milliseconds(started.elapsed()));
        self.observe();
        self.progress.anchors_resident.store(u64::from(self.mapper.n_resident_anchors()), Ordering::Relaxed);
        if let Pace::LockStep { iterations } = self.pace {
            let started = Instant::now();
            self.train(iterations);
            job.times.add(Stage::Mapping, milliseconds(started.elapsed()));
        }
        true
    }

    /// Follows the loops. In lock-step nothing moves between two keyframes: whatever was to, has.
    fn realign(&mut self) {
        let alignment = self.alignment.lock();
        let was_astray = *alignment != *self.mapper.alignment() && self.mapper.realign(&alignment);
        // Whoever closes loops does not wait for what takes the time of some keyframes.
        drop(alignment);
        if was_astray {
            self.mapper.map_anew();
        }
    }

    /// A view where loops have put it by now, with what hangs on it in metres of the map.
    fn align(&self, unaligned: &FrameReport, job: &mut Job) -> FrameReport {
        let moved = self.mapper.alignment().at(unaligned.keyframe_ordinal);
        let scale = moved.scaling();
        for point in &mut job.points {
            point.depth_m *= scale as f32;
        }
        if let Some(road) = &mut job.road {
            road.height_m *= scale;
        }
        let map_from_camera = moved * Similarity::from_isometry(unaligned.world_from_camera, 1.0);
        FrameReport { world_from_camera: map_from_camera.isometry, ..*unaligned }
    }

    /// Notes how full the map's containers are after a keyframe.
    fn observe(&self) {
        let n_anchors = self.mapper.n_resident_anchors() as usize;
        let n_keyframes = self.mapper.counters().keyframes as usize;
        self.usage.observe(Row::MapAnchors, n_anchors);
        // Every anchor has one voxel.
        self.usage.observe(Row::MapVoxels, n_anchors);
        self.usage.observe(Row::MapWorkspaces, 1);
        self.usage.observe(Row::MapNewAnchors, self.mapper.staged_anchors_peak());
        self.usage.observe(Row::MapKeyframeDepths, self.mapper.n_kept_depths());
        // They overwrite their oldest when they are full.
        self.usage.observe(Row::MapKeyframeImages, n_keyframes.min(self.mapper.capacity().images));
        let tables = self.mapper.table_load();
        self.usage.observe(Row::MapKeyframes, tables.keyframes);
        self.usage.observe(Row::MapChunks, tables.chunks);
        self.usage.observe(Row::MapPages, tables.pages);
    }

    fn train(&mut self, n_iterations: u32) {
        let started = Instant::now();
        let steps = self.mapper.optimize(n_iterations);
        self.usage.note_lists(&self.mapper.take_list_load());
        if steps.n_refused > 0 && !self.has_warned_of_steps {
            self.has_warned_of_steps = true;
            log::warn!(
                "the compute device refuses training steps: the map does not learn what the camera sees from now on"
            );
        }
        self.progress.iterations.fetch_add(u64::from(steps.n_iterations), Ordering::Relaxed);
        self.training += started.elapsed();
    }

    /// Stores a view as it was seen: the alignment beside the log says that it is at `map_from_camera` by now.
    fn store_view(&mut self, job: &Job, report: &FrameReport, map_from_camera: &Rigid) {
        let unaligned = &report.world_from_camera;
        // What it spawns is in metres of the map as it is now.
        let scale = self.mapper.alignment().at(report.keyframe_ordinal).scaling().recip();
        let keyframe = StoredKeyframe {
            keyframe_id: report.keyframe_ordinal,
            chunk_id: report.keyframe_ordinal / CHUNK_KEYFRAMES,
            frame_index: report.frame_index,
            timestamp_ns: report.timestamp_ns,
            rotation_xyzw: quaternion_xyzw(&unaligned.rotation),
            translation_m: unaligned.translation.vector.into(),
            scale,
            is_held_out: job.is_held_out,
            image_bytes: 0,
            image_crc: 0,
        };
        let image = StoreImage { pixels: &job.pixels, stride_bytes: self.row_bytes };
        let seen_from = StoredKeyframe {
            rotation_xyzw: quaternion_xyzw(&map_from_camera.rotation),
            translation_m: map_from_camera.translation.vector.into(),
            ..keyframe
        };
        let has_picture = self.pictures.admits(&seen_from);
        self.n_views += usize::from(has_picture || !job.is_held_out);
        if self.n_views > self.max_views {
            self.usage.refuse(Row::StoreKeyframeTable, 1);
        }
        if !has_picture {
            return self.log_place(&keyframe);
        }
        match self.store.write_keyframe(&keyframe, image) {
            Ok(()) => self.pictures.remember(&seen_from),
            Err(WriteRefusal::Busy) => {
                self.n_images_left_out += 1;
                self.usage.refuse(Row::StoreImageQueue, 1);
                self.log_place(&keyframe);
            }
            Err(refused) => self.refuse(&refused),
        }
    }

    /// Stores a view without its picture. A held-out one judges nothing then; a keyframe is needed by its anchors.
    fn log_place(&self, view: &StoredKeyframe) {
        if !view.is_held_out && self.store.place_keyframe(view).is_err() {
            let _lifted = seal::lift();
            log::warn!("keyframe {} could not be logged: the disk is too slow", view.keyframe_id);
        }
    }

    /// Counts a view that will never be in the map; the first is told.
    fn refuse(&mut self, reason: &dyn std::error::Error) {
        // A message takes memory, and there is one of them.
        let _lifted = seal::lift();
        if self.n_views_refused == 0 {
            log::warn!("mapping: {reason}; the map will be without this view, and others like it are only counted");
        }
        self.n_views_refused += 1;
        self.usage.refuse(Row::PipelineKeyframeQueue, 1);
    }

    fn finish(mut self) -> Result<MappingSummary, RunError> {
        let anchors_resident = u64::from(self.mapper.n_resident_anchors());
        self.mapper.finish_into(&self.store)?;
        let counters = self.mapper.counters();
        self.usage.note_map_refusals(&counters.refused);
        self.usage.refuse(Row::MapPages, self.mapper.n_forgotten_pages());
        self.usage.refuse(Row::StoreReturningPages, usize::try_from(counters.pages_denied).unwrap_or(usize::MAX));
        // The mapper's memory is needed for judging the map.
        drop(self.mapper);
        let [n_pages, n_images, n_returning] = self.store.most_buffers();
        self.usage.observe(Row::StorePageQueue, n_pages);
        self.usage.observe(Row::StoreReturningPages, n_returning);
        // The encoder's output is one of the row's images.
        self.usage.observe(Row::StoreImageQueue, n_images + usize::from(n_images > 0));
        let store = self.store.finish()?;
        self.progress.store_bytes.store(store.bytes.store_bytes, Ordering::Relaxed);
        Ok(MappingSummary {
            counters,
            anchors_resident,
            store,
            training: self.training,
            n_images_left_out: self.n_images_left_out,
            n_views_refused: self.n_views_refused,
        })
    }
}
