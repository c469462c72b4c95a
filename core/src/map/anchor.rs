//! The records of an anchor and of the Gaussians that it spawns.

pub use super::numbers::GAUSSIAN_PARAMS;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Numbers of one Gaussian, relative to its anchor and in the axes of the anchor's keyframe.
///
/// The decoded Gaussian in the keyframe's frame is: mean `position + offset * exp(log_extent)`, standard
/// deviations `exp(log_extent + log_scale)`, rotation `quaternion` (normalised on use), opacity
/// `sigmoid(opacity_logit)`, color `sigmoid(color_logit)`.
#[derive(Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct GaussianParams {
    /// Offset from the anchor, in units of the anchor's extent.
    pub offset: [f32; 3],
    /// Natural logarithm of the scale in units of the anchor's extent.
    pub log_scale: [f32; 3],
    /// Rotation `[x, y, z, w]`, not necessarily unit.
    pub quaternion_xyzw: [f32; 4],
    /// Opacity before the logistic function.
    pub opacity_logit: f32,
    /// RGB before the logistic function.
    pub color_logit: [f32; 3],
}

const _: () = assert!(size_of::<GaussianParams>() == GAUSSIAN_PARAMS * size_of::<f32>());

/// What of an anchor never changes by training.
#[derive(Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct AnchorHeader {
    /// Centre of the anchor's voxel, m, in the frame of the keyframe that spawned it.
    pub position_in_keyframe_m: [f32; 3],
    /// Row of that keyframe in the resident keyframe table.
    pub keyframe_row: u32,
    /// Natural logarithm of the anchor's local scale l, per axis, m.
    pub log_extent: [f32; 3],
    /// Level of detail, 0 (finest) to 4.
    pub level: u8,
    /// How many of the slot's Gaussians are in use.
    pub n_gaussians: u8,
    /// Row of the chunk (decoder, background) in the resident chunk table.
    pub chunk_row: u16,
}
const _: () = assert!(size_of::<AnchorHeader>() == 32);
