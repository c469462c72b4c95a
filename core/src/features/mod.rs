//! Points that can be recognised in the next image: corners, and their tracks from frame to frame.

pub mod affine;
pub mod corners;
pub mod descriptors;
pub mod hamming;
pub(crate) mod doubles;
pub(crate) mod lanes;
pub mod lk;
mod pattern;
mod resample;
pub mod tracks;
pub(crate) mod window;

#[cfg(test)]
pub(crate) mod testing;

pub use affine::AffineSettings;
pub use corners::{Corner, CornerReport, CornerSettings};
pub use descriptors::{Descriptor, ExtractScratch, ExtractSettings, Feature};
pub use hamming::{FeatureMatch, HammingSettings, Nearest};
pub use lanes::SimdLevel;
pub use lk::{Flow, LkSettings, LkVerdict};
pub use tracks::{Track, TrackImages, TrackReport, TrackSettings, TrackStorage, TrackTable};
