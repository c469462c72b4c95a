//! Structs that the host and the kernels share; a test compares every member with the WGSL.

use super::kernel_constants::N_LOSS_SUMS;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// The uniform block of every kernel (`shaders/shared/view.wgsl`).
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct ViewBlock {
    /// Width of the picture, px.
    pub width: u32,
    /// Height of the picture, px.
    pub height: u32,
    /// Tiles side by side.
    pub tile_columns: u32,
    /// Rows of tiles.
    pub tile_rows: u32,
    /// Slots below this number may be in use.
    pub n_slots: u32,
    /// Gaussians per slot.
    pub k: u32,
    /// Candidates that fit.
    pub candidate_capacity: u32,
    /// Row entries that fit.
    pub entry_capacity: u32,
    /// Pairs that fit.
    pub pair_capacity: u32,
    /// First texel of the background's chunk row.
    pub first_texel: u32,
    /// Kind of target picture: 0 RGB bytes, 1 gray bytes, 2 RGB reals.
    pub target_kind: u32,
    /// 1 when there is a depth target.
    pub has_depth: u32,
    /// Focal lengths, px.
    pub focal_px: [f32; 2],
    /// Principal point, px.
    pub center_px: [f32; 2],
    /// Smallest x/z and y/z at which the projection is linearised.
    pub min_z1: [f32; 2],
    /// Largest x/z and y/z at which the projection is linearised.
    pub max_z1: [f32; 2],
    /// Largest length of a row of the projection's Jacobian at z = 1, px.
    pub stretch_px: [f32; 2],
    /// 1 when there is an exposure.
    pub has_exposure: u32,
    /// Weight of the mean absolute color difference.
    pub l1_weight: f32,
    /// Ray of pixel coordinate (0, 0) in map axes; the fourth is unused.
    pub ray_corner: [f32; 4],
    /// Change of the ray per px to the right.
    pub ray_right: [f32; 4],
    /// Change of the ray per px down.
    pub ray_down: [f32; 4],
    /// Factor of red, green, blue before they are compared; the fourth is unused.
    pub gain: [f32; 4],
    /// What is then added; the fourth is unused.
    pub bias: [f32; 4],
    /// Weight of `1 - SSIM`.
    pub ssim_weight: f32,
    /// Weight of the mean depth difference, per m.
    pub depth_weight: f32,
    /// Weight of the mean anisotropy.
    pub isotropy_weight: f32,
    /// Confidences of the depth target, summed; 0 for none.
    pub confidence_sum: f32,
    /// Adam step size of offsets.
    pub offset_rate: f32,
    /// Adam step size of logarithms of scales.
    pub log_scale_rate: f32,
    /// Adam step size of quaternions.
    pub rotation_rate: f32,
    /// Adam step size of opacity logits.
    pub opacity_rate: f32,
    /// Adam step size of color logits.
    pub color_rate: f32,
    /// Adam step size of background texels.
    pub background_rate: f32,
    /// Chunk rows with a learned decoder; 0 when the stored numbers are drawn.
    pub decoder_rows: u32,
    /// Adam steps that the background's chunk row has taken, this one included.
    pub background_step: u32,
    /// Chunk row whose decoder learns; [`NO_ROW`](super::kernel_constants::NO_ROW) for none.
    pub decoder_row: u32,
    /// Adam steps that its decoder has taken, this one included.
    pub decoder_step: u32,
    /// Adam step size of features.
    pub feature_rate: f32,
    /// Adam step size of a decoder's hidden layer.
    pub hidden_rate: f32,
    /// Adam step size of a decoder's outputs that are offsets.
    pub output_offset_rate: f32,
    /// The same for logarithms of scales.
    pub output_log_scale_rate: f32,
    /// The same for quaternions.
    pub output_rotation_rate: f32,
    /// The same for opacity logits.
    pub output_opacity_rate: f32,
    /// The same for color logits.
    pub output_color_rate: f32,
    /// 1 when the gradient of the camera's pose is wanted.
    pub finds_pose: u32,
    /// A pixel is wrong when the mean over its channels of the absolute difference is above this.
    pub error_threshold: f32,
    /// Chunk rows whose anchors have no gradient, a bit each; those from 32 on have one.
    pub finished_rows: u32,
}

/// What of an anchor never changes by training, as kernels read it.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct DeviceAnchor {
    /// Centre of the anchor's voxel in its keyframe's frame, m.
    pub position_x: f32,
    /// The same, y.
    pub position_y: f32,
    /// The same, z.
    pub position_z: f32,
    /// Row of the keyframe.
    pub keyframe_row: u32,
    /// Extent, m.
    pub extent_x: f32,
    /// Extent, m.
    pub extent_y: f32,
    /// Extent, m.
    pub extent_z: f32,
    /// Level | used Gaussians << 8 | chunk row << 16.
    pub packed: u32,
}

/// Camera from a keyframe row: rows of `scale * rotation | translation`.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct KeyframeBlock {
    /// First row.
    pub row_x: [f32; 4],
    /// Second row.
    pub row_y: [f32; 4],
    /// Third row.
    pub row_z: [f32; 4],
}

/// Counters of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Counters {
    /// Candidates that were found.
    pub candidates_needed: u32,
    /// Candidates that fit.
    pub candidates: u32,
    /// Gaussians whose splat meets the picture.
    pub visible: u32,
    /// Row entries that were asked for.
    pub entries_needed: u32,
    /// Pairs that were asked for.
    pub pairs_needed: u32,
    /// Pairs that were listed.
    pub pairs: u32,
    /// Pixels where the picture is wrong.
    pub masked_pixels: u32,
    /// Unused.
    pub spare: u32,
}

/// Workgroup counts that kernels find out, three words each.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct IndirectGroups {
    /// One invocation per candidate in groups of [`GROUP`](super::kernel_constants::GROUP): x, y, z.
    pub candidates_x: u32,
    /// Always 1.
    pub candidates_y: u32,
    /// Always 1.
    pub candidates_z: u32,
    /// Unused.
    pub spare: u32,
}

/// A Gaussian as it is blended.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Splat {
    /// Mean, px.
    pub mean_x: f32,
    /// Mean, px.
    pub mean_y: f32,
    /// Binary logarithm of the opacity.
    pub log2_opacity: f32,
    /// Depth along the optical axis, m.
    pub depth_m: f32,
    /// Of `log2 alpha = xx dx^2 + xy dx dy + yy dy^2 + log2_opacity`.
    pub conic_xx: f32,
    /// The same, xy.
    pub conic_xy: f32,
    /// The same, yy.
    pub conic_yy: f32,
    /// First and last pixel row of the box around the ellipse, 16 bits each.
    pub rows_px: u32,
    /// Red.
    pub red: f32,
    /// Green.
    pub green: f32,
    /// Blue.
    pub blue: f32,
    /// First and last pixel column of that box, 16 bits each.
    pub columns_px: u32,
    /// Half width of that box, px.
    pub extent_x: f32,
    /// Half height of that box, px.
    pub extent_y: f32,
    /// Horizontal shift of the middle of a row of the ellipse, per px of dy.
    pub slope: f32,
    /// Half length of the row through the mean, px.
    pub half_px: f32,
}

/// Sums over the picture and the visible Gaussians, in the order of the `SUM_...` constants.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct LossReport {
    /// The sums.
    pub sums: [f32; N_LOSS_SUMS as usize],
}
