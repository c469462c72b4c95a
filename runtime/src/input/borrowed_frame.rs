//! One frame, where the camera process wrote it.

use iceoryx2::sample::Sample;
use kilogs_camera::ipc::{FrameHeader, FramePage, Ipc};
use kilogs_core::conventions::TimestampNs;
use kilogs_core::frame::{ImageTooShort, ImageView, PixelFormat};
use zerocopy::IntoBytes;

use super::SpeedRing;
use super::camera_link::CameraLink;

/// One frame in the shared memory. Dropping it acknowledges it and gives the slot back.
pub struct BorrowedFrame<'input> {
    pub(super) sample: Sample<Ipc, [FramePage], FrameHeader>,
    pub(super) pixel_format: PixelFormat,
    pub(super) timestamp_ns: TimestampNs,
    pub(super) frame_index: u64,
    pub(super) link: &'input CameraLink,
    pub(super) speeds: &'input SpeedRing,
}

impl BorrowedFrame<'_> {
    /// What the frame says about itself.
    pub fn header(&self) -> &FrameHeader {
        self.sample.user_header()
    }

    /// Middle of the exposure. Goes on where a camera process was started anew; otherwise that of the header.
    pub fn timestamp_ns(&self) -> TimestampNs {
        self.timestamp_ns
    }

    /// Which frame of the run it is, missing ones included. Goes on where a camera process was started anew; otherwise
    /// the header's sequence number, counted from the first frame where the camera was there before the tracker.
    pub fn frame_index(&self) -> u64 {
        self.frame_index
    }

    /// What the wheels said up to this frame, on the clock of [`BorrowedFrame::timestamp_ns`]. What was published before
    /// the frame is in it.
    pub fn speeds(&self) -> &SpeedRing {
        self.speeds
    }

    /// How the pixels are to be read.
    pub fn pixel_format(&self) -> PixelFormat {
        self.pixel_format
    }

    /// The pixels, in the memory that the camera process wrote.
    pub fn pixels(&self) -> &[u8] {
        let sent = self.sample.payload().as_bytes();
        // The verdict made sure that the payload holds them.
        &sent[..(self.header().payload_bytes as usize).min(sent.len())]
    }

    /// The pixels of a grey frame (or the luma plane) as an image.
    ///
    /// # Errors
    /// [`ImageTooShort`] for formats whose rows are not grey pixels.
    pub fn grey(&self) -> Result<ImageView<'_>, ImageTooShort> {
        let header = self.header();
        match self.pixel_format {
            PixelFormat::Mono8 | PixelFormat::Nv12 => {
                let [width, height, stride] = [header.width, header.height, header.stride_bytes].map(|n| n as usize);
                ImageView::new(self.pixels(), width, height, stride)
            }
            _ => Err(ImageTooShort { bytes: 0, needed: header.payload_bytes as usize }),
        }
    }
}

impl Drop for BorrowedFrame<'_> {
    fn drop(&mut self) {
        let sequence = self.header().sequence;
        self.link.acknowledge(sequence);
    }
}

impl std::fmt::Debug for BorrowedFrame<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BorrowedFrame").field("header", self.header()).finish_non_exhaustive()
    }
}
