//! The seam between the map and whatever computes its pictures and gradients.
//!
//! The map's trainable numbers live *inside* a backend, one fixed-capacity slot per anchor; the host keeps
//! what never changes by training (voxel, page, level, keyframe) and talks to the backend in whole anchors,
//! whole views and whole training steps. A backend never calls back and never allocates after construction.

pub use kilogs_core::map::{AnchorHeader, GaussianParams};
use nalgebra::{UnitQuaternion, Vector3};

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
