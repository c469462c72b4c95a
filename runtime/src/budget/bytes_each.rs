//! What one element of each row costs. Sizes come from the types that are stored, never from the file.

use super::{Budget, Row};
use kilogs_core::map::anchor::{AnchorHeader, GAUSSIAN_PARAMS};

/// Granularity of shared memory and of the payload of a frame.
const PAGE_BYTES: u64 = 4096;

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

/// Bytes of one element of `row`.
pub(super) fn bytes_each(row: Row, budget: &Budget, input: &PlanInput) -> u64 {
    const F32: u64 = size_of::<f32>() as u64;
    let capacity = |row: Row| budget.entry(row).capacity;
    match row {
        Row::IpcFrameSlots => input.frame_bytes.next_multiple_of(PAGE_BYTES).saturating_add(PAGE_BYTES),
        // Levels halve each side: 1 + 1/4 + 1/16 + ... < 4/3.
        Row::TrackingPyramids => input.pixels() * 4 / 3,
        Row::TrackingCorners => 3 * F32,
        Row::TrackingTracks => 16 * F32,
        Row::TrackingMatches => 16 * F32,
        Row::TrackingKeyframes => 512 + capacity(Row::TrackingTracks) * 3 * F32,
        Row::TrackingLandmarks => 32 * F32,
        Row::TrackingRoadPixels => 4 * F32,
        Row::MapAnchors => {
            // Each trainable number is kept with its gradient and two moments.
            let trainable = GAUSSIAN_PARAMS as u64 * 4 * F32;
            size_of::<AnchorHeader>() as u64 + capacity(Row::MapGaussiansPerAnchor).saturating_mul(trainable)
        }
        Row::MapGaussiansPerAnchor => 0,
        Row::MapVoxels => 4 * F32,
        Row::MapKeyframes => 256,
        Row::MapKeyframeImages => input.mapping_pixels() * u64::from(input.color_channels),
        Row::MapChunks => 64 << 10,
        Row::SplatVisibleGaussians => 150,
        Row::SplatPairs => 8,
        Row::SplatGradientBands => capacity(Row::SplatVisibleGaussians).saturating_mul(10 * F32),
        Row::SplatImageBuffers => input.pixels() * F32,
        Row::StorePageQueue => 1 << 20,
        Row::StoreImageQueue => input.pixels() * u64::from(input.color_channels),
        Row::StoreKeyframeTable => 128,
        Row::TelemetryFrameRecords => 512,
        Row::ProcessCodeAndStacks | Row::ProcessCameraChild => 1,
    }
}
