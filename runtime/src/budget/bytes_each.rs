//! What one element of each row costs. Sizes come from the types that are stored, never from the file.

use super::{Budget, Row};
use crate::output::StageTimes;
use crate::splat::MemoryRow;
use crate::splat::cpu::CpuBackend;
use kilogs_core::bundle::ReducedSystem;
use kilogs_core::features::{Corner, Flow, Track};
use kilogs_core::frame::pyramid;
use kilogs_core::keyframe::{KeyframeWindow, Landmark, WINDOW};
use kilogs_core::map::depth::motion_stereo::MAX_SOURCES;
use kilogs_core::map::depth::sweep::N_LABELS;
use kilogs_core::map::pool::AnchorSlot;
use kilogs_core::map::voxel::VoxelCell;
use kilogs_core::map::{AnchorHeader, GaussianParams};
use kilogs_core::pose::{LandmarkMatch, Match};
use kilogs_core::store::{PageLabel, StoredKeyframe};
use kilogs_core::tracking::{FrameReport, KeyframePoint};

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
        let scaled = |side: u32| (f64::from(side) * self.mapping_resolution).ceil() as u64;
        scaled(self.width) * scaled(self.height)
    }
}

/// Levels of a pyramid: what the tracker asks for.
const PYRAMID_LEVELS: usize = 4;

/// Bytes of one element of `row`.
pub(super) fn bytes_each(row: Row, budget: &Budget, input: &PlanInput) -> u64 {
    let capacity = |row: Row| budget.capacity(row);
    let splat = SplatSizes::of(budget, input);
    let channels = u64::from(input.color_channels);
    let bytes = |n: usize| n as u64;
    match row {
        Row::IpcFrameSlots => {
            let slots = budget.frame_slots();
            slots.shared_bytes(input.frame_bytes) / bytes(slots.n_slots()).max(1)
        }
        Row::TrackingGrayImages => input.pixels(),
        Row::TrackingPyramids => {
            bytes(pyramid::bytes_needed(input.width as usize, input.height as usize, PYRAMID_LEVELS))
        }
        Row::TrackingTracks => bytes(TRACK_BYTES),
        Row::TrackingLandmarks => bytes(size_of::<Landmark>()),
        Row::TrackingKeyframes => bytes((size_of::<KeyframeWindow>() + size_of::<ReducedSystem>()).div_ceil(WINDOW)),
        Row::PipelineKeyframeQueue => {
            input.frame_bytes
                + bytes(size_of::<FrameReport>() + capacity(Row::TrackingTracks) * size_of::<KeyframePoint>())
        }
        Row::MapAnchors => bytes(size_of::<AnchorSlot>() + size_of::<u32>()) + splat.each("splat.anchors"),
        // Their sizes are part of the rows that they multiply.
        Row::MapGaussiansPerAnchor | Row::StorePageAnchors => 0,
        Row::MapNewAnchors => {
            let gaussians = capacity(Row::MapGaussiansPerAnchor) * size_of::<GaussianParams>();
            bytes(gaussians + size_of::<AnchorHeader>() + size_of::<u32>())
        }
        Row::MapVoxels => bytes(size_of::<VoxelCell>()),
        Row::MapKeyframes => splat.each("splat.keyframe_rows"),
        // The brightness stands beside the colors.
        Row::MapKeyframeImages => input.mapping_pixels() * (channels + 1) + splat.each("splat.exposure_slots"),
        Row::MapWorkspaces => workspace_bytes(input),
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

/// A track with its share of every slice that is as long as the tracks.
const TRACK_BYTES: usize = size_of::<Track>()
    + size_of::<Flow>()
    + size_of::<Corner>()
    + size_of::<f32>()
    + size_of::<Match>()
    + size_of::<LandmarkMatch>()
    + size_of::<bool>()
    + 2 * size_of::<u32>()
    + size_of::<KeyframePoint>();

/// Planes of motion stereo at half the training size, and of insertion at the training size.
fn workspace_bytes(input: &PlanInput) -> u64 {
    let pixels = input.mapping_pixels();
    let planes = |n: usize| (n * size_of::<f32>()) as u64;
    let stereo = (3 * N_LABELS + 8 * (1 + MAX_SOURCES) + 2) as u64 + planes(3);
    pixels / 4 * stereo + pixels * (planes(3 + 11) + 1)
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
        let sum = host_part(Row::MapAnchors, size_of::<AnchorSlot>() + size_of::<u32>())
            + host_part(Row::MapKeyframeImages, image)
            + [Row::MapKeyframes, Row::MapChunks, Row::SplatVisibleGaussians, Row::SplatRowEntries, Row::SplatPairs]
                .into_iter()
                .chain([Row::SplatViews])
                .map(planned)
                .sum::<u64>();
        assert_eq!(sum, all);
    }
}
