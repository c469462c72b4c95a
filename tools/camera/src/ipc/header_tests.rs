//! Every kind of bad header.

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
    check(|h| h.version += 1, BadVersion { found: FRAME_VERSION + 1 });
    check(|h| h.pixel_format = 0, UnknownFormat { found: 0 });
    check(|h| h.pixel_format = 3, OtherFormat { found: PixelFormat::Bgr8, expected: PixelFormat::Mono8 });
    check(|h| h.width = 7, WrongSize { found: [7, 4], expected: [6, 4] });
    check(|h| h.height = 0, WrongSize { found: [6, 0], expected: [6, 4] });
    check(|h| h.sequence = 10, SequenceBackwards { found: 10, previous: 10 });
    check(|h| h.sequence = 0, SequenceBackwards { found: 0, previous: 10 });
    let late_ns = PREVIOUS.timestamp_ns + MAX_TIME_STEP_NS;
    check(|h| h.timestamp_ns = late_ns, Accept { pixel_format: PixelFormat::Mono8, n_missing: 0 });
    for found_ns in [late_ns + 1, u64::MAX] {
        check(|h| h.timestamp_ns = found_ns, TimeJump { found_ns, previous_ns: 1000 });
    }
    let far = PREVIOUS.sequence + MAX_SEQUENCE_STEP;
    check(|h| h.sequence = far, Accept { pixel_format: PixelFormat::Mono8, n_missing: MAX_SEQUENCE_STEP - 1 });
    for found in [far + 1, u64::MAX] {
        check(|h| h.sequence = found, SequenceJump { found, previous: 10 });
    }
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
fn the_first_frame_may_have_any_time_but_no_far_number_and_fixes_the_format() {
    let open = ServiceFormat { pixel_format: None, ..SERVICE };
    let verdict = FrameHeader::packed(0, 0, [6, 4], PixelFormat::Rgb8).judge(&open, None, SENT_BYTES);
    assert_eq!(verdict, HeaderVerdict::Accept { pixel_format: PixelFormat::Rgb8, n_missing: 0 });
    let far = FrameHeader::packed(MAX_SEQUENCE_STEP + 1, 0, [6, 4], PixelFormat::Rgb8).judge(&open, None, SENT_BYTES);
    assert_eq!(far, HeaderVerdict::SequenceJump { found: MAX_SEQUENCE_STEP + 1, previous: 0 });
}

#[test]
fn only_a_far_time_may_be_a_clock_that_was_set() {
    let check = |previous_ns: u64, found_ns: u64, expected: bool| {
        let previous = PreviousFrame { timestamp_ns: previous_ns, ..PREVIOUS };
        let header = FrameHeader { timestamp_ns: found_ns, ..good() };
        let verdict = header.judge(&SERVICE, Some(previous), SENT_BYTES);
        assert_eq!(verdict.is_time_jump(), expected, "{verdict}");
    };
    check(1000, 1001, false);
    check(1000, 1001 + MAX_TIME_STEP_NS, true);
    check(1000, MAX_TIMESTAMP_NS, true);
    check(1000, MAX_TIMESTAMP_NS + 1, false);
    check(MAX_TIME_STEP_NS, 0, false);
    check(MAX_TIME_STEP_NS + 1, 0, true);
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
