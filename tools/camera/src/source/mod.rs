//! Where frames come from: a recorded folder or the simulated street.

mod calibration;
mod degrade;
mod folder;
mod image_file;
mod image_list;
mod playback;
mod rectifier;
mod sensor_noise;
mod speed;
mod times;

use std::path::{Path, PathBuf};

use crate::ipc::Speed;
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::conventions::TimestampNs;
pub use kilogs_core::frame::PixelFormat;

pub use degrade::{Degradation, DegradeArgs, Degraded, Effect};
pub use folder::{CameraDescription, FolderSource, describe};
pub use image_list::ImageList;
pub use playback::{Playback, PlaybackRange, STANDING_FRAMES, Schedule};
pub use rectifier::Distortion;
pub(crate) use sensor_noise::add_noise;
pub use speed::{SPEED_FILE_NAME, SpeedFile, WithSpeed};

/// What every frame of a source has in common.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SourceFormat {
    /// Size and intrinsics, pixel centres at +0.5; always a pinhole, because images of a lens are rectified.
    pub camera: Pinhole,
    /// How the camera sits on the vehicle, where the source knows it.
    pub mounting: Option<Mounting>,
    /// Layout of the pixels; rows are packed without padding.
    pub pixel_format: PixelFormat,
    /// Frames in the source, where that is known.
    pub n_frames: Option<u64>,
}

impl SourceFormat {
    /// Bytes of one frame.
    pub fn frame_bytes(&self) -> u64 {
        self.pixel_format.packed_bytes(self.camera.width, self.camera.height)
    }
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
    #[error("reading {}: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and what to try.
        reason: String,
    },
    /// The camera's calibration is missing, contradictory or of a kind that is not supported.
    #[error("setting up the camera from {}: {reason}", path.display())]
    Camera {
        /// Where the calibration came from, or should have come from.
        path: PathBuf,
        /// What is wrong with it, and what to try.
        reason: String,
    },
    /// The wish cannot be fulfilled with this source.
    #[error("playing back: {0}")]
    Range(String),
    /// The frame was left out on purpose.
    #[error("frame {frame} is left out by --degrade gap")]
    LeftOut {
        /// Which one, counted as they are played from 0.
        frame: u64,
    },
}

impl SourceError {
    pub(crate) fn file(path: &Path, reason: impl Into<String>) -> Self {
        Self::File { path: path.to_owned(), reason: reason.into() }
    }

    pub(crate) fn camera(path: &Path, reason: impl Into<String>) -> Self {
        Self::Camera { path: path.to_owned(), reason: reason.into() }
    }
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

    /// The vehicle's next speed reading that is not later than `until_ns`, where the source knows any.
    fn next_speed(&mut self, _until_ns: TimestampNs) -> Option<Speed> {
        None
    }
}

/// Delivers any frame of a finite recording; [`Playback`] turns it into a [`FrameSource`].
pub trait IndexedFrames {
    /// What every frame has in common.
    fn format(&self) -> SourceFormat;

    /// Number of frames, at least one.
    fn n_frames(&self) -> u64;

    /// What frame `index` carries beside its pixels; times rise with the index.
    fn info(&self, index: u64) -> FrameInfo;

    /// Writes the pixels of frame `index` into `pixels` (exactly the format's size in bytes).
    ///
    /// # Errors
    /// [`SourceError`] when this frame cannot be delivered; other frames may still be.
    fn read_frame(&mut self, index: u64, pixels: &mut [u8]) -> Result<(), SourceError>;
}
