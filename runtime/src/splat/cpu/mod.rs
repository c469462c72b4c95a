//! Splatting on the processor: explicit SIMD, a fixed memory, results that do not depend on the thread count.
//!
//! The stages of a view, in order: `decode_anchors` adds what the chunks' decoders say, where they are learned; `cull`
//! lists the Gaussians that may be seen; `splatting` decodes and projects them ([`decode`], [`project`]); `sort` orders them by depth; `bin` lists them per row of tiles and per tile;
//! `blend` draws; `sky` puts the background behind. Training goes on with `loss` and `ssim`, and back through
//! `blend_backward`, `reduce`, `update` (projection, decoding and the optimizer's step in one pass) and
//! `decode_anchors_backward`.
//!
//! Numbers are byte-identical for the same input and SIMD level: every list is cut into pieces that do not depend on
//! the number of threads, and every sum is taken in the order of the pieces.

#![allow(
    clippy::needless_range_loop,
    reason = "kernels index instead of iterating with closures, which would not inherit the instruction set"
)]

mod adam;
mod anchors;
mod backend;
mod bin;
mod blend;
mod blend_backward;
pub(super) mod cull;
pub mod decode;
mod decode_anchors;
mod decode_anchors_backward;
pub(super) mod decoders;
mod draw;
pub(super) mod exposures;
mod features;
mod gradients;
mod grid;
pub mod lane;
mod layers;
mod learn;
pub(super) mod loss;
mod packet;
mod pose;
pub mod project;
mod reduce;
mod score;
mod simd;
pub(super) mod sky;
mod sort;
mod splats;
mod splatting;
mod ssim;
mod update;

#[cfg(test)]
pub(super) mod tests;

pub use backend::{CpuBackend, OpenError};
pub use simd::SimdLevel;
