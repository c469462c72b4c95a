//! Where frames come from: a recorded folder or the simulated street.

use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::conventions::TimestampNs;
pub use kilogs_core::frame::PixelFormat;

/// What every frame of a source has in common.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SourceFormat {
    /// Size and intrinsics, pixel centres at +0.5.
    pub camera: Pinhole,
    /// How the camera sits on the vehicle, where the source knows it.
    pub mounting: Option<Mounting>,
    /// Layout of the pixels; rows are packed without padding.
    pub pixel_format: PixelFormat,
    /// Frames in the source, where that is known.
    pub n_frames: Option<u64>,
}

/// What one frame carries beside its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameInfo {
    /// Middle of the exposure.
    pub timestamp_ns: TimestampNs,
    /// Exposure time, or 0 when unknown.
    pub exposure_us: u32,
}

/// Why a source could not deliver.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// A file could not be read or decoded; the text names it and says what to try.
    #[error("reading {path}: {reason}")]
    File {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong with it, and what to try.
        reason: String,
    },
}

/// Delivers frames in order, straight into the memory that is then published.
pub trait FrameSource {
    /// What every frame has in common.
    fn format(&self) -> SourceFormat;

    /// Writes the next frame's pixels into `pixels` (exactly the format's size in bytes); `None` at the end.
    ///
    /// # Errors
    /// [`SourceError`] when this frame cannot be delivered; the next call goes on with the frame after it.
    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError>;
}
