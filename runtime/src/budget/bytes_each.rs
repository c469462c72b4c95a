//! What one element of each row costs. Sizes come from the types that are stored, never from the file.

use super::{Budget, Row};
use crate::mapping::{capacity as mapper, mapping_camera};
use crate::output::StageTimes;
use crate::splat::MemoryRow;
use crate::splat::cpu::CpuBackend;
use kilogs_core::bundle::ReducedSystem;
use kilogs_core::camera::Pinhole;
use kilogs_core::keyframe::{KeyframeWindow, WINDOW};
use kilogs_core::store::{PageLabel, StoredKeyframe};
use kilogs_core::tracking::{BYTES_PER_LANDMARK, BYTES_PER_TRACK, FrameReport, KeyframePoint};

/// What the plan has to know beside the budget.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanInput {
    /// Width of the camera's image, px.
    pub width: u32,
    /// Height of the camera's image, px.
    pub height: u32,
    /// Bytes of one frame as the capture process publishes it.
    pub frame_bytes: u64,
    /// Channels of the images that the map is trained on: 1 or 3.
    pub color_channels: u32,
    /// Size of the training images relative to the camera's, `mapping.resolution`.
    pub mapping_resolution: f64,
    /// The compute device has memory of its own; false for the CPU and for software devices.
    pub device_has_own_memory: bool,
}

impl PlanInput {
    /// Pixels of the camera's image.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// Pixels of a training image.
    pub fn mapping_pixels(&self) -> u64 {
        let camera = self.mapping_camera();
        u64::from(camera.width) * u64::from(camera.height)
    }

    /// Size of the training images; its intrinsics mean nothing.
    fn mapping_camera(&self) -> Pinhole {
        let (width, height) = (self.width, self.height);
        let native = Pinhole { width, height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        mapping_camera(&native, self.mapping_resolution)
    }
}

/// Bytes of one element of `row`.
pub(super) fn bytes_each(row: Row, budget: &Budget, input: &PlanInput) -> u64 {
    let capacity = |row: Row| budget.capacity(row);
    let splat = SplatSizes::of(budget, input);
    let channels = u64::from(input.color_channels);
    let bytes = |n: usize| n as u64;
    match row {
        Row::IpcFrameSlots => {
            let slots = budget.frame_slots();
            slots.shared_bytes(input.frame_bytes).div_ceil(bytes(slots.n_slots()).max(1))
        }
        Row::TrackingGrayImages => input.pixels(),
        Row::TrackingPyramids => bytes(budget.tracker_capacities(input).bytes_per_pyramid()),
        Row::TrackingTracks => bytes(BYTES_PER_TRACK),
        Row::TrackingLandmarks => bytes(BYTES_PER_LANDMARK),
        Row::TrackingKeyframes => bytes((size_of::<KeyframeWindow>() + size_of::<ReducedSystem>()).div_ceil(WINDOW)),
        Row::PipelineKeyframeQueue => {
            input.frame_bytes
                + bytes(size_of::<FrameReport>() + capacity(Row::TrackingTracks) * size_of::<KeyframePoint>())
        }
        Row::MapAnchors => bytes(mapper::BYTES_PER_ANCHOR) + splat.each("splat.anchors"),
        // Their sizes are part of the rows that they multiply.
        Row::MapGaussiansPerAnchor | Row::StorePageAnchors => 0,
        Row::MapNewAnchors => bytes(mapper::bytes_per_new_anchor(capacity(Row::MapGaussiansPerAnchor))),
        Row::MapVoxels => bytes(mapper::BYTES_PER_VOXEL),
        Row::MapKeyframes => splat.each("splat.keyframe_rows"),
        Row::MapKeyframeImages => {
            let channels = input.color_channels as usize;
            bytes(mapper::bytes_per_image(&input.mapping_camera(), channels)) + splat.each("splat.exposure_slots")
        }
        Row::MapWorkspaces => bytes(mapper::workspace_bytes(&input.mapping_camera())),
        Row::MapChunks => splat.each("splat.chunk_rows"),
        Row::SplatVisibleGaussians => splat.each("splat.visible_gaussians"),
        Row::SplatRowEntries => splat.each("splat.row_entries"),
        Row::SplatPairs => splat.each("splat.pairs"),
        Row::SplatViews => splat.all("splat.image_pixels") + splat.all("splat.training_pixels"),
        Row::StorePageQueue => bytes(budget.store_capacity().page_bytes),
        Row::StoreImageQueue => input.pixels() * channels,
        Row::StoreKeyframeTable => bytes(size_of::<StoredKeyframe>() + size_of::<PageLabel>()),
        Row::TelemetryFrameRecords => bytes(size_of::<FrameReport>() + size_of::<StageTimes>()),
        Row::ProcessCodeAndStacks | Row::ProcessCameraChild => 1,
    }
}

/// The splat backend's own plan.
struct SplatSizes([MemoryRow; 9]);

impl SplatSizes {
    fn of(budget: &Budget, input: &PlanInput) -> Self {
        Self(CpuBackend::memory_plan(&budget.splat_capacities(input)))
    }

    fn find(&self, name: &str) -> Option<&MemoryRow> {
        let found = self.0.iter().find(|part| part.name == name);
        debug_assert!(found.is_some(), "the splat backend has no row {name}");
        found
    }

    fn each(&self, name: &str) -> u64 {
        self.find(name).map_or(0, |part| part.bytes_per_element as u64)
    }

    fn all(&self, name: &str) -> u64 {
        self.find(name).map_or(0, |part| part.bytes() as u64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_of_the_splat_backend_is_in_the_plan() {
        let budget = Budget::builtin().expect("valid");
        let input = PlanInput {
            width: 1241,
            height: 376,
            frame_bytes: 1241 * 376 * 3,
            color_channels: 3,
            mapping_resolution: 0.5,
            device_has_own_memory: false,
        };
        let splat = SplatSizes::of(&budget, &input);
        let all: u64 = splat.0.iter().map(|part| part.bytes() as u64).sum();
        let planned = |row: Row| bytes_each(row, &budget, &input) * budget.entry(row).capacity;
        let host_part = |row: Row, each: usize| planned(row) - each as u64 * budget.entry(row).capacity;
        let image = input.mapping_pixels() as usize * 4;
        let sum = host_part(Row::MapAnchors, mapper::BYTES_PER_ANCHOR)
            + host_part(Row::MapKeyframeImages, image)
            + [Row::MapKeyframes, Row::MapChunks, Row::SplatVisibleGaussians, Row::SplatRowEntries, Row::SplatPairs]
                .into_iter()
                .chain([Row::SplatViews])
                .map(planned)
                .sum::<u64>();
        assert_eq!(sum, all);
    }
}
