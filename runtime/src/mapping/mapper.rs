//! The mapper: what it owns, and the order in which a keyframe passes through it.

use super::capacity::MapperCapacity;
use super::decoder::ChunkDecoders;
use super::depth::{MotionStereo, SparseDepth};
use super::depths::KeyframeDepths;
use super::images::{KeptKeyframe, KeyframeImages, MappingImage};
use super::list_load::ListLoad;
use super::optimize::OptimizeReport;
use super::paging::Paging;
use super::scratch::{ImageScratch, NO_GAUSSIAN, Staging};
use super::settings::MapperSettings;
use super::shrink::mapping_camera;
use super::sink::PageSink;
use super::sky::Sky;
use crate::map_store::{Alignment, MapStoreWriter, StoreError, WriteRefusal, is_held_out_frame};
use crate::splat::{Exposure, GaussianParams, SplatBackend};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::{Rigid, TimestampNs};
use kilogs_core::map::insertion::MapImageSize;
use kilogs_core::map::pool::{AnchorPool, AnchorSlot};
use kilogs_core::map::quota::{GaussianQuota, RouteMeasure};
use kilogs_core::map::voxel::{VoxelCell, VoxelGrid};
use kilogs_core::tracking::{KeyframePoint, RoadPlane};
use std::ops::Add;

/// Keyframes of one chunk.
pub const CHUNK_KEYFRAMES: u32 = 100;

/// A keyframe with everything that mapping needs of it; borrowed for one call.
#[derive(Debug, Clone, Copy)]
pub struct KeyframePacket<'a> {
    /// Ordinal among the keyframes, growing.
    pub ordinal: u32,
    /// Index of the frame in its stream.
    pub frame_index: u64,
    /// Middle of the exposure.
    pub timestamp_ns: TimestampNs,
    /// Where the camera was.
    pub world_from_camera: Rigid,
    /// What it saw, at native resolution.
    pub image: MappingImage<'a>,
    /// Triangulated tracks, in native pixels.
    pub points: &'a [KeyframePoint],
    /// The road, where it was seen.
    pub road: Option<RoadPlane>,
}

/// A keyframe was not taken; nothing was added to the map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum PacketRefused {
    /// Every eighth frame judges the map and must not make it: promote another one.
    #[error("frame {frame_index} is held out and never used for mapping; promote the next frame")]
    HeldOut {
        /// Index of the frame.
        frame_index: u64,
    },
    /// Anchors still use the row that the keyframe needs, because the sink does not take them.
    #[error(
        "frame {frame_index} finds no row for its keyframe, because the map store is behind or has stopped; \
         raise [map.keyframes] in the budget, or write to a faster disk"
    )]
    RowInUse {
        /// Index of the frame.
        frame_index: u64,
    },
    /// The image does not have the bytes or the format that the camera has.
    #[error("the image of frame {frame_index} does not fit the mapper's camera; drop the frame")]
    ImageDoesNotFit {
        /// Index of the frame.
        frame_index: u64,
    },
}

/// What a keyframe brought into the map.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct InsertReport {
    /// Pixels that asked for a Gaussian.
    pub n_samples: u32,
    /// Anchors that were created.
    pub n_anchors: u32,
    /// Gaussians that were created.
    pub n_gaussians: u32,
    /// Samples whose voxel was taken.
    pub n_occupied: u32,
    /// Samples for which there was no room.
    pub refused: MapRefusals<u32>,
    /// Mean transmittance of the map before the insertion: how much was bare.
    pub mean_transmittance: f32,
    /// Whether depth came from motion stereo.
    pub from_stereo: bool,
}

/// Samples for which there was no room, by the container that was full.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MapRefusals<N> {
    /// The anchors that one keyframe may spawn.
    pub new_anchors: N,
    /// The anchors in memory.
    pub anchors: N,
    /// The voxel grid.
    pub voxels: N,
}

impl<N: Copy + Into<u64>> MapRefusals<N> {
    /// All of them.
    pub fn total(&self) -> u64 {
        self.new_anchors.into() + self.anchors.into() + self.voxels.into()
    }
}

impl<N: Copy + Add<Output = N>> MapRefusals<N> {
    fn plus<M: Copy + Into<N>>(&self, more: &MapRefusals<M>) -> Self {
        Self {
            new_anchors: self.new_anchors + more.new_anchors.into(),
            anchors: self.anchors + more.anchors.into(),
            voxels: self.voxels + more.voxels.into(),
        }
    }
}

/// Counts over the whole run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct MapCounters {
    /// Keyframes taken.
    pub keyframes: u64,
    /// Anchors created.
    pub anchors_total: u64,
    /// Gaussians created.
    pub gaussians_total: u64,
    /// Samples refused because something was full.
    pub refused: MapRefusals<u64>,
    /// Largest number of anchors that lived at once.
    pub anchors_resident_peak: u64,
    /// Anchors that ended because all their Gaussians were faint or oversized, or their keyframe was astray.
    pub anchors_pruned: u64,
    /// Anchors handed to the sink.
    pub anchors_stored: u64,
    /// Pages handed to the sink.
    pub pages_written: u64,
    /// Pages that came back from disk.
    pub pages_returned: u64,
    /// Pages that found no room to come back when the vehicle was near.
    pub pages_denied: u64,
    /// Pages that were damaged or gone when they were to come back.
    pub pages_lost: u64,
    /// Returned anchors that ended because their voxel had one already.
    pub anchors_merged: u64,
    /// Optimizer steps taken.
    pub iterations: u64,
}

/// Builds the map; see the module.
pub struct Mapper {
    pub(super) settings: MapperSettings,
    pub(super) capacity: MapperCapacity,
    pub(super) backend: Box<dyn SplatBackend>,
    pub(super) pool: AnchorPool<Box<[AnchorSlot]>>,
    pub(super) grid: VoxelGrid<Box<[VoxelCell]>>,
    pub(super) images: KeyframeImages,
    pub(super) stereo: MotionStereo,
    pub(super) sparse: SparseDepth,
    pub(super) depths: KeyframeDepths,
    pub(super) scratch: ImageScratch,
    pub(super) staging: Staging,
    pub(super) paging: Paging,
    /// The Gaussians of an anchor on its way back.
    pub(super) returning: Box<[GaussianParams]>,
    pub(super) quota: GaussianQuota,
    route_measure: RouteMeasure,
    pub(super) sky: Sky,
    pub(super) decoders: ChunkDecoders,
    pub(super) alignment: Alignment,
    /// Keyframes before this one are where they are in the map, as a loop or whoever gives poses says.
    pub(super) tied_until: u32,
    pub(super) counters: MapCounters,
    /// Steps that were asked for, taken or not: each draws its own numbers.
    pub(super) n_draws: u64,
    pub(super) list_load: ListLoad,
}

impl Mapper {
    /// Allocates everything. `backend` must hold what `capacity` says; `channels` is 1 for grey cameras, else 3.
    pub fn new(
        settings: MapperSettings,
        capacity: MapperCapacity,
        native: &Pinhole,
        channels: usize,
        backend: Box<dyn SplatBackend>,
    ) -> Self {
        let camera = mapping_camera(native, settings.resolution);
        let size = MapImageSize { width: camera.width as usize, height: camera.height as usize };
        let n_depths = if settings.trains_depth() { capacity.depths } else { 0 };
        Self {
            settings,
            capacity,
            backend,
            pool: AnchorPool::new(vec![AnchorSlot::EMPTY; capacity.anchors].into()),
            grid: VoxelGrid::new(vec![VoxelCell::EMPTY; capacity.voxels].into()),
            images: KeyframeImages::new(*native, camera, channels, capacity.images),
            stereo: MotionStereo::new(&camera),
            sparse: SparseDepth,
            depths: KeyframeDepths::new(size.n_pixels(), n_depths),
            scratch: ImageScratch::new(size, capacity.new_anchors * capacity.gaussians_per_anchor),
            staging: Staging::new(capacity.new_anchors, capacity.anchors, capacity.gaussians_per_anchor),
            paging: Paging::new(&capacity, &camera),
            returning: vec![NO_GAUSSIAN; capacity.gaussians_per_anchor].into(),
            quota: GaussianQuota::new(settings.gaussians_per_m, settings.first_view_m),
            route_measure: RouteMeasure::new(settings.first_view_m, native),
            sky: Sky::new(),
            decoders: ChunkDecoders::new(&capacity, settings.learned_decoder),
            alignment: Alignment::with_capacity(capacity.alignment_steps),
            tied_until: 0,
            counters: MapCounters::default(),
            n_draws: 0,
            list_load: ListLoad::default(),
        }
    }

    /// Takes a keyframe: keeps its image, inserts what the map lacks, drops what is faint, hands over what is far.
    ///
    /// # Errors
    /// [`PacketRefused`]; nothing was added to the map.
    pub fn insert_keyframe(
        &mut self,
        packet: &KeyframePacket<'_>,
        sink: &mut dyn PageSink,
    ) -> Result<InsertReport, PacketRefused> {
        let frame_index = packet.frame_index;
        if is_held_out_frame(frame_index) {
            return Err(PacketRefused::HeldOut { frame_index });
        }
        self.look_from(packet);
        self.make_rows(packet.ordinal, sink).map_err(|_| PacketRefused::RowInUse { frame_index })?;
        let keyframe = KeptKeyframe { ordinal: packet.ordinal, world_from_camera: packet.world_from_camera };
        if !self.images.push(keyframe, &packet.image) {
            return Err(PacketRefused::ImageDoesNotFit { frame_index });
        }
        if !self.admit_keyframe(packet.ordinal, &packet.world_from_camera) {
            return Err(PacketRefused::RowInUse { frame_index });
        }
        let nearest_m =
            self.paging.directory.nearest_view_m(&self.route_measure, packet.ordinal, &packet.world_from_camera);
        self.quota.arrive(nearest_m);
        self.begin_exposure();
        self.begin_decoder(packet.ordinal);
        self.prune_after_window();
        self.prune_in_the_way();
        self.evict_far_pages(packet, sink);
        let mut report = InsertReport::default();
        if self.counters.keyframes == 1 {
            // The first keyframe had nobody to be compared with; now it has.
            report = self.insert_from((1, 0), &[0], &[], packet.road);
        }
        let newest = self.insert_from((0, 0), &[1, 2, 3], packet.points, packet.road);
        report = InsertReport {
            n_samples: report.n_samples + newest.n_samples,
            n_anchors: report.n_anchors + newest.n_anchors,
            n_gaussians: report.n_gaussians + newest.n_gaussians,
            n_occupied: report.n_occupied + newest.n_occupied,
            refused: report.refused.plus(&newest.refused),
            ..newest
        };
        self.count(&report);
        Ok(report)
    }

    /// Takes `n_iterations` optimizer steps over the window and a few older keyframes.
    pub fn optimize(&mut self, n_iterations: u32) -> OptimizeReport {
        self.run_optimizer(n_iterations)
    }

    /// Hands over everything that is resident.
    ///
    /// # Errors
    /// [`WriteRefusal`]: when it is busy come again, after every other refusal coming again does not help.
    pub fn finish(&mut self, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        self.evict_everything(sink)
    }

    /// Hands over everything that is resident, and waits for the disk as often as it takes. A store that stopped says why
    /// when it is finished.
    ///
    /// # Errors
    /// [`StoreError::Incomplete`]: drop the store, what it holds is not the whole map.
    pub fn finish_into(&mut self, store: &MapStoreWriter) -> Result<(), StoreError> {
        loop {
            match self.finish(&mut &*store) {
                Err(WriteRefusal::Busy) if store.flush().is_ok() => {}
                Ok(()) | Err(WriteRefusal::Busy | WriteRefusal::Stopped) => return Ok(()),
                Err(refused @ WriteRefusal::TooLarge) => return Err(StoreError::Incomplete(refused)),
            }
        }
    }

    /// Counts over the whole run.
    pub fn counters(&self) -> MapCounters {
        self.counters
    }

    /// How full the lists of the backend were since the last call.
    pub fn take_list_load(&mut self) -> ListLoad {
        std::mem::take(&mut self.list_load)
    }

    /// Sizes fixed at construction.
    pub fn capacity(&self) -> &MapperCapacity {
        &self.capacity
    }

    /// Most anchors that were ever on their way into or out of the backend at once.
    pub fn staged_anchors_peak(&self) -> usize {
        self.staging.peak()
    }

    /// Keyframes whose depth is kept to train on; none while no step looks at depth.
    pub fn n_kept_depths(&self) -> usize {
        self.depths.len()
    }

    /// Anchors that live now.
    pub fn n_resident_anchors(&self) -> u32 {
        self.pool.n_live()
    }

    /// The newest keyframe's picture counts as exposed like the map until steps say otherwise.
    fn begin_exposure(&mut self) {
        if let Some(slot) = self.images.newest(0).and_then(|kept| self.exposure_slot(kept.place)) {
            self.backend.write_exposure(slot, Exposure::IDENTITY);
        }
    }

    /// Slot of the exposure of the image in this place of the ring; `None` when exposures are not learned.
    pub(super) fn exposure_slot(&self, place: usize) -> Option<u32> {
        self.settings.learned_exposure.then_some(place as u32)
    }

    fn count(&mut self, report: &InsertReport) {
        self.counters.keyframes += 1;
        self.count_inserted(report);
    }

    pub(super) fn count_inserted(&mut self, report: &InsertReport) {
        let counters = &mut self.counters;
        counters.anchors_total += u64::from(report.n_anchors);
        counters.gaussians_total += u64::from(report.n_gaussians);
        counters.refused = counters.refused.plus(&report.refused);
        counters.anchors_resident_peak = counters.anchors_resident_peak.max(u64::from(self.pool.n_live()));
    }
}
