//! How large a mapper is: fixed before it starts.

use super::pages::PageGroup;
use super::sky::Sky;
use crate::splat::{BACKGROUND_TEXELS, DecoderShape};
use kilogs_core::camera::Pinhole;
use kilogs_core::map::depth::aggregate;
use kilogs_core::map::depth::motion_stereo::MAX_SOURCES;
use kilogs_core::map::depth::sweep::N_LABELS;
use kilogs_core::map::insertion::InsertionSample;
use kilogs_core::map::pool::AnchorSlot;
use kilogs_core::map::voxel::VoxelCell;
use kilogs_core::map::{AnchorFeature, AnchorHeader, GaussianParams};
use kilogs_core::store::chunk_record_bytes;

/// Bytes of the place of a keyframe, or of a chunk, that has a row.
pub use crate::splat::BYTES_PER_ROW;

/// Sizes fixed at construction; a mapper's memory follows from them alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MapperCapacity {
    /// Anchors that live at once; must be what the splat backend holds.
    pub anchors: usize,
    /// Gaussians of an anchor; must be what the splat backend holds.
    pub gaussians_per_anchor: usize,
    /// Cells of the voxel grid, at least four thirds of the anchors.
    pub voxels: usize,
    /// Keyframe images kept for training.
    pub images: usize,
    /// Keyframes whose depth is kept for training.
    pub depths: usize,
    /// Anchors that one keyframe may spawn.
    pub new_anchors: usize,
    /// Rows of the backend's keyframe table.
    pub keyframe_rows: usize,
    /// Rows of the backend's chunk table.
    pub chunk_rows: usize,
    /// Pages (of [`PAGE_KEYFRAMES`](super::PAGE_KEYFRAMES) keyframes) that are in memory or can come back.
    pub pages: usize,
    /// Keyframes that loops move, each on its own.
    pub alignment_steps: usize,
    /// Files on their way back; at least 2, or none comes back.
    pub returning_files: usize,
}

/// Bytes of what is known of the keyframes of a page.
pub const BYTES_PER_PAGE: usize = size_of::<PageGroup>();

/// Bytes of the pool's slot of an anchor, and of its place in the stage.
pub const BYTES_PER_ANCHOR: usize = size_of::<AnchorSlot>() + size_of::<u32>();

/// Bytes of a cell of the voxel grid.
pub const BYTES_PER_VOXEL: usize = size_of::<VoxelCell>();

/// Bytes of a keyframe image at mapping resolution, with its brightness.
pub fn bytes_per_image(camera: &Pinhole, bytes_per_pixel: usize) -> usize {
    n_pixels(camera) * (bytes_per_pixel + 1)
}

/// Bytes of a keyframe's depth and confidence at mapping resolution.
pub fn bytes_per_depth(camera: &Pinhole) -> usize {
    n_pixels(camera) * 2 * size_of::<f32>()
}

/// Bytes of an anchor that is about to be spawned.
pub fn bytes_per_new_anchor(gaussians_per_anchor: usize) -> usize {
    gaussians_per_anchor * (size_of::<GaussianParams>() + size_of::<InsertionSample>())
        + size_of::<AnchorHeader>()
        + size_of::<AnchorFeature>()
        + size_of::<u32>()
}

/// Bytes of a chunk's file: its background, and the decoder that it may have.
pub fn chunk_file_bytes(gaussians_per_anchor: usize) -> usize {
    chunk_record_bytes(DecoderShape::new(gaussians_per_anchor).len() * size_of::<f32>(), BACKGROUND_TEXELS)
}

/// Bytes of the planes of motion stereo, at half the mapping resolution, and of insertion, and of a chunk on its way.
pub fn workspace_bytes(camera: &Pinhole, gaussians_per_anchor: usize) -> usize {
    let half_width = camera.width as usize / 2;
    let half_pixels = half_width * (camera.height as usize / 2);
    let stereo = half_pixels * (3 * N_LABELS + 8 * (1 + MAX_SOURCES) + 2 + 12)
        + aggregate::scratch_len(half_width) * size_of::<u16>();
    // Color, depth, transmittance, luma, error, two structures, two edges, probability, inverse depth, confidence, blur.
    let insertion = n_pixels(camera) * (12 + 12 * size_of::<f32>() + 1);
    stereo + insertion + chunk_file_bytes(gaussians_per_anchor) + Sky::BYTES
}

fn n_pixels(camera: &Pinhole) -> usize {
    camera.width as usize * camera.height as usize
}
