//! The header that travels beside every frame, and the judgement whether it can be believed.

use std::fmt;

use iceoryx2::prelude::ZeroCopySend;
use kilogs_core::conventions::TimestampNs;
use kilogs_core::frame::PixelFormat;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// "KGSF" read as a little-endian number.
pub const FRAME_MAGIC: u32 = u32::from_le_bytes(*b"KGSF");

/// Raised when the meaning or the place of a field changes.
pub const FRAME_VERSION: u32 = 2;

/// Bits of [`FrameHeader::flags`].
pub mod flags {
    /// The stream is complete; this message carries no pixels and its sequence number is one past the last frame's.
    pub const END: u32 = 1;
}

/// A time further than this from that of the frame before is a jump, ns: no camera pauses for a minute between two
/// frames without its clock or its header being at fault.
pub const MAX_TIME_STEP_NS: u64 = 60_000_000_000;

/// A sequence number further than this above the one before is none: a minute, the longest step in time, of a camera with
/// 1000 frames a second.
pub const MAX_SEQUENCE_STEP: u64 = 60_000;

/// Times above this lie behind the year 2262 and are none.
pub const MAX_TIMESTAMP_NS: u64 = i64::MAX as u64;

/// What a frame says about itself. The numbers are those of the machine that runs both processes.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[type_name("KilogsFrameHeader2")]
pub struct FrameHeader {
    /// [`FRAME_MAGIC`].
    pub magic: u32,
    /// [`FRAME_VERSION`].
    pub version: u32,
    /// Counts the frames of one camera process from 0; a gap is a frame that was lost or could not be read.
    pub sequence: u64,
    /// Middle of the exposure, ns.
    pub timestamp_ns: TimestampNs,
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// Bytes between the starts of two rows.
    pub stride_bytes: u32,
    /// [`PixelFormat`] by its wire number.
    pub pixel_format: u32,
    /// Exposure time, or 0 when unknown.
    pub exposure_us: u32,
    /// Analogue gain as a factor, or 0 when unknown.
    pub gain: f32,
    /// Which camera of the vehicle.
    pub camera_id: u32,
    /// See [`flags`].
    pub flags: u32,
    /// Bytes of the payload that belong to the image.
    pub payload_bytes: u64,
}
// Capture processes in other languages write these bytes.
const _: () = assert!(size_of::<FrameHeader>() == 64 && core::mem::offset_of!(FrameHeader, payload_bytes) == 56);

/// What every frame of a service must look like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ServiceFormat {
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// `None` until a first frame has fixed it.
    pub pixel_format: Option<PixelFormat>,
}

/// The frame before, of the same camera process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PreviousFrame {
    /// Its sequence number.
    pub sequence: u64,
    /// Its time.
    pub timestamp_ns: TimestampNs,
}

/// Whether a frame can be used, with the numbers that decided.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HeaderVerdict {
    /// Use it.
    Accept {
        /// How its bytes are to be read.
        pixel_format: PixelFormat,
        /// Frames between this one and the one before that never arrived.
        n_missing: u64,
    },
    /// The stream is complete.
    End {
        /// Frames after the last one that never arrived.
        n_missing: u64,
    },
    /// Not a frame of ours: another program publishes under this name.
    BadMagic {
        /// What was there.
        found: u32,
    },
    /// The camera process is of another version: rebuild or update it.
    BadVersion {
        /// Version of the camera process.
        found: u32,
    },
    /// The number of the pixel format is none we know.
    UnknownFormat {
        /// What was there.
        found: u32,
    },
    /// The pixel format changed within a service.
    OtherFormat {
        /// What was there.
        found: PixelFormat,
        /// What the service carries.
        expected: PixelFormat,
    },
    /// The image has not the size of the service: the calibration would not hold.
    WrongSize {
        /// Width and height that were there, px.
        found: [u32; 2],
        /// Width and height of the service, px.
        expected: [u32; 2],
    },
    /// Size, stride and payload length contradict each other, or the payload is shorter than they say.
    DoesNotFit {
        /// Bytes that size and stride ask for.
        needed_bytes: u64,
        /// Bytes that the header claims.
        claimed_bytes: u64,
        /// Bytes that were sent.
        sent_bytes: u64,
    },
    /// The sequence number is not above that of the frame before: two cameras share the name, or frames were reordered.
    SequenceBackwards {
        /// What was there.
        found: u64,
        /// That of the frame before.
        previous: u64,
    },
    /// The time is not after that of the frame before: the clock of the camera was set, or frames were reordered.
    TimeBackwards {
        /// What was there.
        found_ns: u64,
        /// That of the frame before.
        previous_ns: u64,
    },
    /// The time is too far after that of the frame before: a damaged header, or the clock of the camera was set. In
    /// the second case the next frame agrees with this one.
    TimeJump {
        /// What was there.
        found_ns: u64,
        /// That of the frame before; 0 when there was none.
        previous_ns: u64,
    },
    /// The sequence number is too far above that of the frame before: a damaged header, or the camera counts anew. In the
    /// second case the next frame agrees with this one.
    SequenceJump {
        /// What was there.
        found: u64,
        /// That of the frame before; 0 when there was none.
        previous: u64,
    },
    /// Another camera process is alive under the same service name.
    SecondCamera,
}

impl FrameHeader {
    /// Header of a packed image.
    pub fn packed(sequence: u64, timestamp_ns: TimestampNs, size: [u32; 2], pixel_format: PixelFormat) -> Self {
        let [width, height] = size;
        Self {
            magic: FRAME_MAGIC,
            version: FRAME_VERSION,
            sequence,
            timestamp_ns,
            payload_bytes: pixel_format.packed_bytes(width, height),
            width,
            height,
            stride_bytes: pixel_format.row_bytes(width) as u32,
            pixel_format: pixel_format as u32,
            ..Self::default()
        }
    }

    /// The message that says that no frame follows.
    pub fn end_of_stream(sequence: u64, timestamp_ns: TimestampNs) -> Self {
        Self {
            magic: FRAME_MAGIC,
            version: FRAME_VERSION,
            sequence,
            timestamp_ns,
            flags: flags::END,
            ..Self::default()
        }
    }

    /// Decides whether the frame can be used. `sent_bytes` is what arrived beside the header.
    pub fn judge(&self, expected: &ServiceFormat, previous: Option<PreviousFrame>, sent_bytes: u64) -> HeaderVerdict {
        if self.magic != FRAME_MAGIC {
            return HeaderVerdict::BadMagic { found: self.magic };
        }
        if self.version != FRAME_VERSION {
            return HeaderVerdict::BadVersion { found: self.version };
        }
        if let Some(refusal) = self.judge_image(expected, sent_bytes) {
            return refusal;
        }
        let n_missing = match previous {
            None if self.sequence > MAX_SEQUENCE_STEP => {
                return HeaderVerdict::SequenceJump { found: self.sequence, previous: 0 };
            }
            None => self.sequence,
            Some(previous) if self.sequence.saturating_sub(previous.sequence) > MAX_SEQUENCE_STEP => {
                return HeaderVerdict::SequenceJump { found: self.sequence, previous: previous.sequence };
            }
            Some(previous) if self.sequence <= previous.sequence => {
                return HeaderVerdict::SequenceBackwards { found: self.sequence, previous: previous.sequence };
            }
            Some(previous) => self.sequence - previous.sequence - 1,
        };
        if self.is_end() {
            return HeaderVerdict::End { n_missing };
        }
        match (previous, PixelFormat::from_wire(self.pixel_format)) {
            (Some(previous), _) if self.timestamp_ns <= previous.timestamp_ns => {
                HeaderVerdict::TimeBackwards { found_ns: self.timestamp_ns, previous_ns: previous.timestamp_ns }
            }
            (previous, _) if self.timestamp_ns > latest_possible_ns(previous) => HeaderVerdict::TimeJump {
                found_ns: self.timestamp_ns,
                previous_ns: previous.map_or(0, |previous| previous.timestamp_ns),
            },
            (_, Some(pixel_format)) => HeaderVerdict::Accept { pixel_format, n_missing },
            (_, None) => HeaderVerdict::UnknownFormat { found: self.pixel_format },
        }
    }

    /// Whether this is the message without pixels that ends the stream.
    pub fn is_end(&self) -> bool {
        self.flags & flags::END != 0
    }

    fn judge_image(&self, expected: &ServiceFormat, sent_bytes: u64) -> Option<HeaderVerdict> {
        if self.is_end() {
            return None;
        }
        let Some(pixel_format) = PixelFormat::from_wire(self.pixel_format) else {
            return Some(HeaderVerdict::UnknownFormat { found: self.pixel_format });
        };
        if let Some(expected) = expected.pixel_format.filter(|&expected| expected != pixel_format) {
            return Some(HeaderVerdict::OtherFormat { found: pixel_format, expected });
        }
        let (found, expected) = ([self.width, self.height], [expected.width, expected.height]);
        if found != expected {
            return Some(HeaderVerdict::WrongSize { found, expected });
        }
        // The wider of stride and row, so that a stride below the row cannot make a short payload pass.
        let row_bytes = pixel_format.row_bytes(self.width);
        let needed_bytes = row_bytes.max(u64::from(self.stride_bytes)) * pixel_format.n_rows(self.height);
        let fits = u64::from(self.stride_bytes) >= row_bytes
            && needed_bytes <= self.payload_bytes
            && self.payload_bytes <= sent_bytes;
        (!fits).then_some(HeaderVerdict::DoesNotFit { needed_bytes, claimed_bytes: self.payload_bytes, sent_bytes })
    }
}

/// The latest time that a frame after `previous` can have.
fn latest_possible_ns(previous: Option<PreviousFrame>) -> u64 {
    let step_ns = |previous: PreviousFrame| previous.timestamp_ns.saturating_add(MAX_TIME_STEP_NS);
    previous.map_or(MAX_TIMESTAMP_NS, step_ns).min(MAX_TIMESTAMP_NS)
}

impl HeaderVerdict {
    /// Whether the time is so far from that of the frame before that the clock may have been set.
    pub fn is_time_jump(&self) -> bool {
        match *self {
            Self::TimeJump { found_ns, .. } => found_ns <= MAX_TIMESTAMP_NS,
            Self::TimeBackwards { found_ns, previous_ns } => previous_ns - found_ns > MAX_TIME_STEP_NS,
            _ => false,
        }
    }

    /// Whether the frame must not be used.
    pub fn is_refusal(&self) -> bool {
        !matches!(self, Self::Accept { .. } | Self::End { .. })
    }
}

impl fmt::Display for HeaderVerdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Accept { pixel_format, n_missing } => write!(f, "{pixel_format:?} frame, {n_missing} missing before"),
            Self::End { n_missing } => write!(f, "end of the stream, {n_missing} frames missing before"),
            Self::BadMagic { found } => {
                write!(f, "not a frame of ours: magic {found:#010x} instead of {FRAME_MAGIC:#010x}")
            }
            Self::BadVersion { found } => {
                write!(f, "frame header version {found}, this program reads {FRAME_VERSION}")
            }
            Self::UnknownFormat { found } => write!(f, "pixel format {found} is unknown"),
            Self::OtherFormat { found, expected } => {
                write!(f, "pixel format {found:?}, the service carries {expected:?}")
            }
            Self::WrongSize { found: [width, height], expected: [expected_width, expected_height] } => {
                write!(f, "image of {width}x{height} px, the camera has {expected_width}x{expected_height} px")
            }
            Self::DoesNotFit { needed_bytes, claimed_bytes, sent_bytes } => write!(
                f,
                "header does not fit its payload: size and stride need {needed_bytes} bytes, \
                 {claimed_bytes} are claimed, {sent_bytes} were sent"
            ),
            Self::SequenceBackwards { found, previous } => {
                write!(f, "sequence number {found} is not above {previous}")
            }
            Self::TimeBackwards { found_ns, previous_ns } => {
                write!(f, "time {found_ns} ns is not after {previous_ns} ns")
            }
            Self::TimeJump { found_ns, previous_ns } => {
                write!(f, "time {found_ns} ns is no time for a frame after {previous_ns} ns")
            }
            Self::SequenceJump { found, previous } => {
                write!(f, "sequence number {found} is no number for a frame after {previous}")
            }
            Self::SecondCamera => write!(f, "a second camera process publishes under the same service name"),
        }
    }
}

#[cfg(test)]
#[path = "header_tests.rs"]
mod tests;
