//! The header that travels beside every frame, and the judgement whether it can be believed.

use std::fmt;

use iceoryx2::prelude::ZeroCopySend;
use kilogs_core::conventions::TimestampNs;
use kilogs_core::frame::PixelFormat;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// "KGSF" read as a little-endian number.
pub const FRAME_MAGIC: u32 = u32::from_le_bytes(*b"KGSF");

/// Raised when the meaning or the place of a field changes.
pub const FRAME_VERSION: u32 = 1;

/// Bits of [`FrameHeader::flags`].
pub mod flags {
    /// The stream is complete; this message carries no pixels and its sequence number is one past the last frame's.
    pub const END: u32 = 1;
}

/// What a frame says about itself. The numbers are those of the machine that runs both processes.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[type_name("KilogsFrameHeader1")]
pub struct FrameHeader {
    /// [`FRAME_MAGIC`].
    pub magic: u32,
    /// [`FRAME_VERSION`].
    pub version: u32,
    /// Counts the frames of one camera process from 0; a gap is a frame that was lost or could not be read.
    pub sequence: u64,
    /// Middle of the exposure, ns.
    pub timestamp_ns: TimestampNs,
    /// Bytes of the payload that belong to the image.
    pub payload_bytes: u64,
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
}
const _: () = assert!(size_of::<FrameHeader>() == 64);

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
            None => self.sequence,
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

impl HeaderVerdict {
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
            Self::SecondCamera => write!(f, "a second camera process publishes under the same service name"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SERVICE: ServiceFormat = ServiceFormat { width: 6, height: 4, pixel_format: Some(PixelFormat::Mono8) };
    const PREVIOUS: PreviousFrame = PreviousFrame { sequence: 10, timestamp_ns: 1000 };
    const SENT_BYTES: u64 = 4096;

    fn good() -> FrameHeader {
        FrameHeader::packed(11, 1001, [6, 4], PixelFormat::Mono8)
    }

    fn check(spoil: impl Fn(&mut FrameHeader), expected: HeaderVerdict) {
        let mut header = good();
        spoil(&mut header);
        assert_eq!(header.judge(&SERVICE, Some(PREVIOUS), SENT_BYTES), expected);
        let usable = matches!(expected, HeaderVerdict::Accept { .. } | HeaderVerdict::End { .. });
        assert_eq!(expected.is_refusal(), !usable, "{expected}");
    }

    #[test]
    fn every_kind_of_bad_header_is_told_apart() {
        use HeaderVerdict::*;
        check(|_| (), Accept { pixel_format: PixelFormat::Mono8, n_missing: 0 });
        check(|h| h.sequence = 14, Accept { pixel_format: PixelFormat::Mono8, n_missing: 3 });
        check(|h| h.magic = 7, BadMagic { found: 7 });
        check(|h| h.version = 2, BadVersion { found: 2 });
        check(|h| h.pixel_format = 0, UnknownFormat { found: 0 });
        check(|h| h.pixel_format = 3, OtherFormat { found: PixelFormat::Bgr8, expected: PixelFormat::Mono8 });
        check(|h| h.width = 7, WrongSize { found: [7, 4], expected: [6, 4] });
        check(|h| h.height = 0, WrongSize { found: [6, 0], expected: [6, 4] });
        check(|h| h.sequence = 10, SequenceBackwards { found: 10, previous: 10 });
        check(|h| h.sequence = 0, SequenceBackwards { found: 0, previous: 10 });
        check(|h| h.timestamp_ns = 1000, TimeBackwards { found_ns: 1000, previous_ns: 1000 });
        check(|h| h.timestamp_ns = 0, TimeBackwards { found_ns: 0, previous_ns: 1000 });
    }

    #[test]
    fn a_header_must_fit_its_payload() {
        let check_fit = |stride_bytes: u32, claimed_bytes: u64, needed_bytes: Option<u64>| {
            let spoil = |h: &mut FrameHeader| (h.stride_bytes, h.payload_bytes) = (stride_bytes, claimed_bytes);
            let verdict = match needed_bytes {
                None => HeaderVerdict::Accept { pixel_format: PixelFormat::Mono8, n_missing: 0 },
                Some(needed_bytes) => HeaderVerdict::DoesNotFit { needed_bytes, claimed_bytes, sent_bytes: SENT_BYTES },
            };
            check(spoil, verdict);
        };
        check_fit(6, 24, None);
        check_fit(8, 32, None);
        check_fit(1024, 4096, None);
        check_fit(8, 24, Some(32));
        check_fit(5, 24, Some(24));
        check_fit(0, 0, Some(24));
        check_fit(6, 23, Some(24));
        check_fit(6, 4097, Some(24));
        check_fit(u32::MAX, u64::MAX, Some(4 * u64::from(u32::MAX)));
    }

    #[test]
    fn the_end_needs_no_image_and_tells_how_many_frames_are_missing() {
        let judge = |sequence| FrameHeader::end_of_stream(sequence, 0).judge(&SERVICE, Some(PREVIOUS), 0);
        assert_eq!(judge(11), HeaderVerdict::End { n_missing: 0 });
        assert_eq!(judge(13), HeaderVerdict::End { n_missing: 2 });
        assert_eq!(judge(10), HeaderVerdict::SequenceBackwards { found: 10, previous: 10 });
        let no_frame_at_all = FrameHeader::end_of_stream(0, 0).judge(&SERVICE, None, 0);
        assert_eq!(no_frame_at_all, HeaderVerdict::End { n_missing: 0 });
    }

    #[test]
    fn the_first_frame_may_have_any_time_and_fixes_the_format() {
        let open = ServiceFormat { pixel_format: None, ..SERVICE };
        let verdict = FrameHeader::packed(0, 0, [6, 4], PixelFormat::Rgb8).judge(&open, None, SENT_BYTES);
        assert_eq!(verdict, HeaderVerdict::Accept { pixel_format: PixelFormat::Rgb8, n_missing: 0 });
    }

    #[test]
    fn no_header_whatever_passes_with_pixels_outside_its_payload() {
        let mut rng = kilogs_core::math::Rng::new(1, 2, 3);
        let mut n_accepted = 0;
        for _ in 0..200_000 {
            let mut header = good();
            // Spoils one to three bytes of a good header.
            for _ in 0..1 + rng.next_u32() % 3 {
                let at = rng.next_u32() as usize % size_of::<FrameHeader>();
                header.as_mut_bytes()[at] = rng.next_u32() as u8;
            }
            let sent_bytes = u64::from(rng.next_u32() % 64);
            if let HeaderVerdict::Accept { pixel_format, .. } = header.judge(&SERVICE, Some(PREVIOUS), sent_bytes) {
                n_accepted += 1;
                assert!(header.payload_bytes <= sent_bytes && pixel_format == PixelFormat::Mono8);
                assert!(u64::from(header.stride_bytes) * 4 <= header.payload_bytes && header.stride_bytes >= 6);
            }
        }
        assert!(n_accepted > 1000, "{n_accepted}");
    }
}
