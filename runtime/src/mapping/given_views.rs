//! Training on views that are handed in, in any order and at any resolution: when all of them are known beforehand.

use super::images::KeptKeyframe;
use super::mapper::{CHUNK_KEYFRAMES, InsertReport, KeyframePacket, Mapper, PacketRefused};
use super::sink::PageSink;
use crate::splat::{RenderStats, StepReport, StepSettings, TargetImage, TrainingView, View};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::map::quota::GaussianQuota;

/// A view with its picture.
#[derive(Debug, Clone, Copy)]
pub struct GivenView<'a> {
    /// Ordinal of the keyframe that it is.
    pub ordinal: u32,
    /// Where the camera was.
    pub world_from_camera: Rigid,
    /// Intrinsics at the picture's size.
    pub camera: Pinhole,
    /// What it saw.
    pub target: TargetImage<'a>,
}

fn refused_step() -> StepReport {
    StepReport { stats: RenderStats { refused: true, ..RenderStats::default() }, ..StepReport::default() }
}

impl Mapper {
    /// Takes one optimizer step on a view; the decoder of its chunk learns. Refused when its chunk is not in memory.
    pub fn train_on(&mut self, given: &GivenView<'_>, step: &StepSettings) -> StepReport {
        let Some(chunk_row) = self.chunk_row(given.ordinal) else { return refused_step() };
        let view = View { camera_from_map: given.world_from_camera.inverse(), camera: given.camera, chunk_row };
        let training = TrainingView { view, target: given.target, depth: None, exposure_slot: None };
        let step = StepSettings { decoder_row: Some(view.chunk_row), ..*step };
        let report = self.backend.train_step(&training, &step);
        self.list_load.add(&report.stats);
        self.counters.iterations += u64::from(!report.stats.refused);
        report
    }

    /// Inserts all that pictures ask for: given views are no route.
    pub fn lift_quota(&mut self) {
        self.quota = GaussianQuota::unlimited();
        // None of them is of an earlier drive.
        self.settings.first_view_m = 0.0;
    }

    /// Looks at a keyframe's image again without inserting from it: what is revisited next compares itself with it.
    ///
    /// # Errors
    /// [`PacketRefused::ImageDoesNotFit`].
    pub fn look_again(&mut self, packet: &KeyframePacket<'_>) -> Result<(), PacketRefused> {
        let keyframe = KeptKeyframe { ordinal: packet.ordinal, world_from_camera: packet.world_from_camera };
        if self.images.push(keyframe, &packet.image) {
            return Ok(());
        }
        Err(PacketRefused::ImageDoesNotFit { frame_index: packet.frame_index })
    }

    /// Inserts once more from a keyframe whose anchors are resident, where the trained map is bare or wrong. Depth
    /// comes from the `n_sources` keyframes that were looked at before it; `visit` is 1 the first time.
    ///
    /// # Errors
    /// [`PacketRefused::ImageDoesNotFit`].
    pub fn revisit(
        &mut self,
        packet: &KeyframePacket<'_>,
        (n_sources, visit): (usize, u32),
    ) -> Result<InsertReport, PacketRefused> {
        self.look_again(packet)?;
        let sources = [1, 2, 3];
        let report = self.insert_from((0, visit), &sources[..n_sources.min(sources.len())], packet.points, packet.road);
        self.count_inserted(&report);
        Ok(report)
    }

    /// Drops what is faint or oversized among the Gaussians of a keyframe.
    pub fn prune_keyframe(&mut self, ordinal: u32) {
        self.prune(ordinal);
    }

    /// Whether the anchors of a keyframe are in memory.
    pub fn holds_keyframe(&self, ordinal: u32) -> bool {
        self.paging.directory.holds(ordinal)
    }

    /// Hands over the present sky of a keyframe's chunk: it was trained after the chunk had been complete.
    pub fn store_chunk_of(&mut self, ordinal: u32, sink: &mut dyn PageSink) -> bool {
        self.write_chunk(ordinal / CHUNK_KEYFRAMES, sink).is_ok()
    }

    /// Hands over the oldest keyframes' anchors; false when there is nothing to hand over but the newest, or the sink
    /// is busy.
    pub fn evict_oldest(&mut self, sink: &mut dyn PageSink) -> bool {
        self.evict_oldest_group(sink)
    }
}
