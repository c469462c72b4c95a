//! Every bad header is refused, counted, told and acknowledged, and the next good frame still gets through.

use std::time::Duration;

use iceoryx2::port::{notifier::Notifier, publisher::Publisher};
use kilogs::input::{
    FrameInput, FrameSlots, HeaderVerdict, InputEvent, InputSettings, ServiceFormat, unique_service_name,
};
use kilogs_camera::ipc::{
    FrameHeader, FramePage, FrameService, Ipc, IpcNode, create_node, frames_name, open_events, open_frames,
};
use kilogs_core::frame::PixelFormat;

const PATIENCE: Duration = Duration::from_secs(30);
const SIZE: [u32; 2] = [48, 32];

/// A camera that sends whatever it is told to.
struct Rogue {
    publisher: Publisher<Ipc, [FramePage], FrameHeader>,
    notifier: Notifier<Ipc>,
    _frames: FrameService,
    _node: IpcNode,
}

impl Rogue {
    fn new(service: &str) -> Self {
        let node = create_node(service).expect("a node");
        let frames = open_frames(&node, service, &FrameSlots::DEFAULT).expect("a service");
        let publisher = frames.publisher_builder().initial_max_slice_len(2).create().expect("a publisher");
        let events = open_events(&node, &frames_name(service)).expect("events");
        let notifier = events.notifier_builder().create().expect("a notifier");
        Self { publisher, notifier, _frames: frames, _node: node }
    }

    fn send(&self, header: FrameHeader) {
        let mut sample = self.publisher.loan_slice(1).expect("a slot");
        *sample.user_header_mut() = header;
        sample.send().expect("a reader");
        self.notifier.notify().expect("a listener");
    }
}

fn open(purpose: &str) -> (FrameInput, String) {
    let service = unique_service_name(purpose);
    (open_at(&service, false), service)
}

fn open_at(service: &str, is_recorded: bool) -> FrameInput {
    let format = ServiceFormat { width: SIZE[0], height: SIZE[1], pixel_format: Some(PixelFormat::Mono8) };
    let settings = InputSettings {
        service: service.to_owned(),
        format,
        slots: FrameSlots::DEFAULT,
        is_recorded,
        speed_readings: 64,
    };
    FrameInput::open(&settings).expect("shared memory")
}

/// The next event that is about a frame: its sequence number, or why it was refused.
fn next(input: &mut FrameInput) -> Result<u64, HeaderVerdict> {
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => return Ok(frame.header().sequence),
            InputEvent::Refused(verdict) => return Err(verdict),
            InputEvent::CameraCame { .. } => (),
            other => panic!("{other:?}"),
        }
    }
}

#[test]
fn each_bad_header_is_refused_and_the_next_good_frame_is_taken() {
    let (mut input, service) = open("headers");
    let rogue = Rogue::new(&service);
    let (mut sequence, mut n_refused) = (0, 0);
    let mut check = |spoil: &dyn Fn(&mut FrameHeader), is_expected: &dyn Fn(&HeaderVerdict) -> bool| {
        let good = FrameHeader::packed(sequence, 1000 + sequence, SIZE, PixelFormat::Mono8);
        rogue.send(good);
        assert_eq!(next(&mut input), Ok(sequence));
        let mut bad = FrameHeader { sequence: sequence + 1, timestamp_ns: 1001 + sequence, ..good };
        spoil(&mut bad);
        rogue.send(bad);
        let verdict = next(&mut input).expect_err("a refusal");
        assert!(is_expected(&verdict), "{verdict}");
        sequence += 2;
        n_refused += 1;
        let counts = input.counts();
        assert_eq!((counts.n_received, counts.n_refused), (n_refused, n_refused));
    };
    check(&|h| h.magic = 1, &|v| matches!(v, HeaderVerdict::BadMagic { found: 1 }));
    check(&|h| h.version = 9, &|v| matches!(v, HeaderVerdict::BadVersion { found: 9 }));
    check(&|h| h.pixel_format = 99, &|v| matches!(v, HeaderVerdict::UnknownFormat { found: 99 }));
    check(&|h| h.pixel_format = 6, &|v| matches!(v, HeaderVerdict::OtherFormat { found: PixelFormat::BayerRggb8, .. }));
    check(&|h| h.width = 49, &|v| matches!(v, HeaderVerdict::WrongSize { found: [49, 32], .. }));
    check(&|h| h.payload_bytes = 10, &|v| matches!(v, HeaderVerdict::DoesNotFit { needed_bytes: 1536, .. }));
    check(&|h| h.payload_bytes = 5000, &|v| matches!(v, HeaderVerdict::DoesNotFit { sent_bytes: 4096, .. }));
    check(&|h| h.stride_bytes = 400, &|v| matches!(v, HeaderVerdict::DoesNotFit { needed_bytes: 12800, .. }));
    check(&|h| h.timestamp_ns = 5, &|v| matches!(v, HeaderVerdict::TimeBackwards { found_ns: 5, .. }));
    check(&|h| h.timestamp_ns = u64::MAX, &|v| matches!(v, HeaderVerdict::TimeJump { found_ns: u64::MAX, .. }));
    check(&|h| h.timestamp_ns = 1 << 50, &|v| matches!(v, HeaderVerdict::TimeJump { .. }));
    check(&|h| h.sequence = 1 << 50, &|v| matches!(v, HeaderVerdict::SequenceJump { .. }));
    check(&|h| h.sequence = 1, &|v| matches!(v, HeaderVerdict::SequenceBackwards { found: 1, .. }));
}

/// Sends frames with these times; what became of each: the time that the tracker sees, or `None` when refused.
fn times_of(purpose: &str, sent_ns: &[u64]) -> Vec<Option<u64>> {
    let (input, service) = open(purpose);
    times_at(input, &service, sent_ns)
}

fn times_at(mut input: FrameInput, service: &str, sent_ns: &[u64]) -> Vec<Option<u64>> {
    let rogue = Rogue::new(service);
    let mut seen = Vec::new();
    for (sequence, &timestamp_ns) in sent_ns.iter().enumerate() {
        rogue.send(FrameHeader::packed(sequence as u64, timestamp_ns, SIZE, PixelFormat::Mono8));
        seen.push(loop {
            match input.wait(PATIENCE).expect("shared memory") {
                InputEvent::Frame(frame) => break Some(frame.timestamp_ns()),
                InputEvent::Refused(_) => break None,
                _ => (),
            }
        });
    }
    seen
}

#[test]
fn one_far_time_is_refused_and_a_clock_that_was_set_is_followed() {
    const FAR_NS: u64 = 1 << 60;
    let one = times_of("far", &[10, FAR_NS, 20, 0, 30]);
    assert_eq!(one, [Some(10), None, Some(20), None, Some(30)]);
    let two_different = times_of("damaged", &[10, FAR_NS, FAR_NS * 2, 20]);
    assert_eq!(two_different, [Some(10), None, None, Some(20)]);
    for (purpose, sent_ns) in [
        ("set-forward", [10, 20, FAR_NS, FAR_NS + 10, FAR_NS + 20]),
        ("set-back", [FAR_NS, FAR_NS + 10, 10, 20, 30]),
        ("bad-first", [FAR_NS, 10, 20, 30, 40]),
    ] {
        let seen = times_of(purpose, &sent_ns);
        assert_eq!(seen.iter().filter(|time| time.is_none()).count(), 1, "{purpose}: {seen:?}");
        let seen_ns: Vec<u64> = seen.into_iter().flatten().collect();
        assert!(seen_ns.windows(2).all(|pair| pair[0] < pair[1]), "{purpose}: {seen_ns:?}");
        assert_eq!(seen_ns[3] - seen_ns[2], 10, "{purpose}: {seen_ns:?}");
        let jump_ns = seen_ns[3] - seen_ns[0];
        assert!(jump_ns < 60_000_000_000, "{purpose}: time goes on, it does not jump: {seen_ns:?}");
    }
}

#[test]
fn a_pause_in_a_recording_is_as_long_as_it_was() {
    const PAUSE_NS: u64 = 1 << 40;
    let service = unique_service_name("pause");
    let seen = times_at(open_at(&service, true), &service, &[10, 20, PAUSE_NS, PAUSE_NS + 10, PAUSE_NS + 20]);
    // Only its second frame shows that the first was no damaged header.
    assert_eq!(seen, [Some(10), Some(20), None, Some(PAUSE_NS + 10), Some(PAUSE_NS + 20)]);
}

#[test]
fn a_camera_that_was_replaced_unseen_is_told_before_its_first_frame() {
    let (mut input, service) = open("replaced");
    let first = Rogue::new(&service);
    first.send(FrameHeader::packed(0, 1000, SIZE, PixelFormat::Mono8));
    assert_eq!(next(&mut input), Ok(0));
    drop(first);
    let second = Rogue::new(&service);
    second.send(FrameHeader::packed(0, 2000, SIZE, PixelFormat::Mono8));
    let mut told = Vec::new();
    while told.len() < 3 {
        told.push(match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => format!("frame {}", frame.frame_index()),
            InputEvent::CameraGone { .. } => "gone".to_owned(),
            InputEvent::CameraCame { is_first } => format!("came, first: {is_first}"),
            other => panic!("{other:?}"),
        });
    }
    assert_eq!(told, ["gone", "came, first: false", "frame 1"]);
    assert_eq!(input.counts().n_restarts, 1);
}

/// Sends frames with these sequence numbers to a tracker that comes after or before the camera; the index that each gets
/// in the run, or `None` when refused, and how many frames are missing.
fn indices_of(camera_is_first: bool, sent: &[u64]) -> (Vec<Option<u64>>, u64) {
    let service = unique_service_name("numbers");
    let early = camera_is_first.then(|| Rogue::new(&service));
    let mut input = open_at(&service, false);
    let rogue = early.unwrap_or_else(|| Rogue::new(&service));
    let mut seen = Vec::new();
    for (nth, &sequence) in sent.iter().enumerate() {
        rogue.send(FrameHeader::packed(sequence, 1000 * (nth as u64 + 1), SIZE, PixelFormat::Mono8));
        seen.push(loop {
            match input.wait(PATIENCE).expect("shared memory") {
                InputEvent::Frame(frame) => break Some(frame.frame_index()),
                InputEvent::Refused(_) => break None,
                _ => (),
            }
        });
    }
    let n_indices = seen.iter().flatten().last().map_or(0, |last| last + 1);
    assert_eq!(input.n_frame_indices(), n_indices, "{seen:?}");
    (seen, input.counts().n_missing)
}

#[test]
fn a_damaged_number_makes_no_rows_and_the_frames_after_it_get_through() {
    const FAR: u64 = 1 << 40;
    const RUNNING: u64 = 5000;
    let check = |camera_is_first: bool, sent: &[u64], indices: &[Option<u64>], n_missing: u64| {
        let seen = indices_of(camera_is_first, sent);
        assert_eq!(seen, (indices.to_vec(), n_missing), "{sent:?}, camera first: {camera_is_first}");
    };
    // What a camera numbered before its first frame arrived is missing, unless it was running before the tracker.
    check(false, &[2, 3, 5], &[Some(2), Some(3), Some(5)], 3);
    check(true, &[RUNNING, RUNNING + 1, RUNNING + 3], &[Some(0), Some(1), Some(3)], 1);
    for camera_is_first in [false, true] {
        check(camera_is_first, &[FAR, 0, 1, 2], &[None, Some(0), Some(1), Some(2)], 0);
        check(camera_is_first, &[0, FAR, 2], &[Some(0), None, Some(2)], 1);
        // A camera that has run for years, and one that counts anew.
        check(camera_is_first, &[FAR, FAR + 1, FAR + 3], &[None, Some(0), Some(2)], 1);
        check(camera_is_first, &[0, 1, FAR, FAR + 1], &[Some(0), Some(1), None, Some(2)], 0);
    }
    // A number that is too high and not far enough to be noticed does not end the run.
    check(true, &[RUNNING, 1, 2, 3], &[Some(0), None, Some(1), Some(2)], 0);
}

#[test]
fn a_second_camera_under_the_same_name_is_refused_while_the_first_lives() {
    let (mut input, service) = open("second");
    let first = Rogue::new(&service);
    let second = Rogue::new(&service);
    let frame = |sequence| FrameHeader::packed(sequence, 10 + sequence, SIZE, PixelFormat::Mono8);
    first.send(frame(5));
    assert_eq!(next(&mut input), Ok(5));
    second.send(frame(6));
    assert_eq!(next(&mut input), Err(HeaderVerdict::SecondCamera));
    first.send(frame(6));
    assert_eq!(next(&mut input), Ok(6));
    drop(first);
    second.send(frame(0));
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                assert_eq!(frame.header().sequence, 0);
                assert!(frame.timestamp_ns() > 16, "time goes on after the first camera's");
                break;
            }
            InputEvent::CameraGone { .. } | InputEvent::CameraCame { .. } => (),
            other => panic!("{other:?}"),
        }
    }
    assert_eq!(input.counts().n_restarts, 1);
}
