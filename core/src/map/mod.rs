//! The map: anchors on a hierarchical voxel grid, each relative to the keyframe that spawned it.

pub mod anchor;
pub mod decoder;
pub mod depth;
pub mod insertion;
pub mod lod;
pub mod numbers;
pub mod pool;
pub mod quota;
pub mod side;
pub mod spawn;
pub mod voxel;

pub use anchor::{AnchorHeader, GaussianParams};
pub use decoder::{AnchorFeature, DecoderShape};
