//! Points that can be recognised in the next image: corners, and their tracks from frame to frame.

pub mod lk;
mod window;

#[cfg(test)]
mod testing;

pub use lk::{Flow, LkSettings, LkVerdict};

/// Which SIMD instructions the machine has: a token made once at start-up by the caller (`SimdLevel::new()`
/// detects, `SimdLevel::Scalar` always works). The results have the same bits on every level.
pub use pulp::Arch as SimdLevel;
