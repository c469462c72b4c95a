//! The seam between the map and whatever computes its pictures and gradients.
//!
//! The map's trainable numbers live *inside* a backend, one fixed-capacity slot per anchor; the host keeps
//! what never changes by training (voxel, page, level, keyframe) and talks to the backend in whole anchors,
//! whole views and whole training steps. A backend never calls back and never allocates after construction.

use nalgebra::{UnitQuaternion, Vector3};

/// Numbers of one Gaussian, relative to its anchor and in the axes of the anchor's keyframe.
///
/// The decoded Gaussian in the keyframe's frame is: mean `position + offset * exp(log_extent)`, standard
/// deviations `exp(log_extent + log_scale)`, rotation `quaternion` (normalised on use), opacity
/// `sigmoid(opacity_logit)`, color `sigmoid(color_logit)`.
#[derive(Clone, Copy, Debug, PartialEq)]
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

/// Trainable numbers per Gaussian.
pub const GAUSSIAN_PARAMS: usize = 14;
const _: () = assert!(size_of::<GaussianParams>() == GAUSSIAN_PARAMS * size_of::<f32>());

/// What of an anchor never changes by training.
#[derive(Clone, Copy, Debug, PartialEq)]
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

/// Similarity that takes keyframe coordinates to the map: `x_map = scale * R x_keyframe + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyframePlacement {
    /// Rotation of `map_from_keyframe`.
    pub rotation: UnitQuaternion<f64>,
    /// Translation of `map_from_keyframe`, m.
    pub translation_m: Vector3<f64>,
    /// Scale of `map_from_keyframe`; 1 until a loop closure corrects it.
    pub scale: f64,
}

/// The camera that looks at the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Camera from map.
    pub camera_from_map: kilogs_core::conventions::Rigid,
    /// Intrinsics at the size to render.
    pub camera: kilogs_core::camera::Pinhole,
    /// Chunk whose background colors the sky.
    pub chunk_row: u16,
}
