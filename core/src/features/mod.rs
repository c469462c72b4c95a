//! Points that can be recognised in the next image: corners, and their tracks from frame to frame.

pub mod corners;
pub mod lk;
pub mod tracks;
mod window;

#[cfg(test)]
mod testing;

pub use corners::{Corner, CornerReport, CornerSettings};
pub use lk::{Flow, LkSettings, LkVerdict};
pub use tracks::{Track, TrackImages, TrackReport, TrackSettings, TrackStorage, TrackTable};

/// Which SIMD instructions the machine has: a token made once at start-up by the caller (`SimdLevel::new()`
/// detects, `SimdLevel::Scalar` always works). The results have the same bits on every level.
pub use pulp::Arch as SimdLevel;
