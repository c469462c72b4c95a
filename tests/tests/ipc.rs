//! Camera and tracker as real processes: every frame arrives where it was written, and every misfortune is told.

use std::time::{Duration, Instant};

use clap::Parser;
use kilogs::input::{
    CameraChild, CameraState, FrameInput, FrameSlots, InputCounts, InputEvent, InputSettings, ServiceFormat,
    SharedMapping, unique_service_name,
};
use kilogs_camera::cli::{CameraArgs, run};
use kilogs_core::frame::PixelFormat;
use kilogs_tests::camera::{
    SIZE, camera_process_arguments, color_recording, grey_recording, grey_value, handed_over_arguments,
};

/// Long enough for a loaded machine; no test waits for it when all goes well.
const PATIENCE: Duration = Duration::from_secs(30);

/// Not a test of its own: the camera process of the other tests.
#[test]
#[ignore = "runs as the camera process of the other tests"]
fn acts_as_camera() {
    let Some(arguments) = handed_over_arguments() else { return };
    let args = CameraArgs::parse_from(["kilogs-camera".to_owned()].into_iter().chain(arguments));
    if let Err(error) = run(&args) {
        eprintln!("{error}");
        std::process::exit(i32::from(error.exit_code()));
    }
}

fn open(purpose: &str) -> (FrameInput, String) {
    open_at(unique_service_name(purpose))
}

fn open_at(service: String) -> (FrameInput, String) {
    let format = ServiceFormat { width: SIZE[0], height: SIZE[1], pixel_format: None };
    let settings = InputSettings {
        service: service.clone(),
        format,
        slots: FrameSlots::DEFAULT,
        is_recorded: false,
        speed_readings: 64,
    };
    (FrameInput::open(&settings).expect("shared memory"), service)
}

fn camera(dataset: &std::path::Path, service: &str, more: &[&str]) -> CameraChild {
    let dataset = dataset.display().to_string();
    let arguments = [&["folder", dataset.as_str(), "--service", service, "--quiet"], more].concat();
    CameraChild::start(camera_process_arguments(&arguments)).expect("a camera process")
}

/// What a whole stream brought.
#[derive(Default)]
struct Heard {
    sequences: Vec<u64>,
    times_ns: Vec<u64>,
    n_came: u32,
}

/// Listens to the end of the stream; `look` sees each frame's sequence number and pixels.
fn listen(input: &mut FrameInput, look: impl Fn(u64, &[u8])) -> Heard {
    let mut heard = Heard::default();
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                look(frame.header().sequence, frame.pixels());
                heard.sequences.push(frame.header().sequence);
                heard.times_ns.push(frame.timestamp_ns());
            }
            InputEvent::CameraCame { .. } => heard.n_came += 1,
            InputEvent::End => return heard,
            other => panic!("{other:?} in the middle of the stream"),
        }
    }
}

#[test]
fn every_grey_frame_arrives_in_order_and_whole() {
    let recording = grey_recording(20);
    let (mut input, service) = open("grey");
    let mut camera = camera(recording.path(), &service, &[]);
    let heard = listen(&mut input, |sequence, pixels| {
        let expected: Vec<u8> =
            (0..SIZE[1]).flat_map(|y| (0..SIZE[0]).map(move |x| grey_value(sequence, x, y))).collect();
        assert_eq!(pixels, expected, "frame {sequence}");
    });
    assert_eq!(heard.sequences, (0..20).collect::<Vec<u64>>());
    assert_eq!(heard.times_ns, (0..20).map(|i| i * 100_000_000).collect::<Vec<u64>>());
    assert_eq!(heard.n_came, 1);
    assert_eq!(input.counts(), InputCounts { n_received: 20, ..InputCounts::default() });
    drop(input);
    assert_eq!(camera.wait(PATIENCE).and_then(|status| status.code()), Some(0));
}

#[test]
fn color_arrives_as_rgb() {
    let recording = color_recording(3);
    let (mut input, service) = open("color");
    let _camera = camera(recording.path(), &service, &[]);
    let heard = listen(&mut input, |sequence, pixels| {
        assert_eq!(pixels.len(), 3 * (SIZE[0] * SIZE[1]) as usize);
        let red = grey_value(sequence, 1, 0);
        assert_eq!(pixels[3..6], [red, red.wrapping_add(1), red.wrapping_add(2)]);
    });
    assert_eq!(heard.sequences, [0, 1, 2]);
}

#[test]
fn pixels_are_read_where_the_camera_process_wrote_them() {
    let recording = grey_recording(3);
    let (mut input, service) = open("zero-copy");
    let _camera = camera(recording.path(), &service, &[]);
    listen(&mut input, |_, pixels| {
        let mapping = SharedMapping::holding(pixels).expect("pixels in shared memory");
        assert!(mapping.path.contains("iox2"), "{mapping:?}");
        assert_eq!(pixels.as_ptr().addr() % 4096, 0, "a frame starts on a page");
        let copy = pixels.to_vec();
        assert_eq!(SharedMapping::holding(&copy), None, "a copy would be noticed");
    });
}

#[test]
fn a_camera_that_never_comes_is_a_state_and_no_hang() {
    let (mut input, service) = open("nobody");
    let started = Instant::now();
    let InputEvent::Timeout { camera, silent_for } = input.wait(Duration::from_millis(100)).expect("shared memory")
    else {
        panic!("nobody came");
    };
    assert_eq!(camera, CameraState::NeverCame);
    assert!(silent_for <= started.elapsed() + Duration::from_secs(1) && started.elapsed() < PATIENCE);
    let said = camera.describe(&service, silent_for);
    assert!(said.contains("is the camera process running"), "{said}");
}

#[test]
fn a_killed_camera_is_told_within_a_second_and_another_one_taken_up() {
    let recording = grey_recording(200);
    let (mut input, service) = open("kill");
    let live = ["--live", "--wait-for-tracker", "30"];
    let mut first = Some(camera(recording.path(), &service, &live));
    let mut killed = None;
    let (mut told_after, mut last_ns) = (None, 0);
    let mut n_after_restart = 0;
    let mut second = None;
    while n_after_restart < 3 {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                assert!(last_ns == 0 || frame.timestamp_ns() > last_ns, "time goes on");
                last_ns = frame.timestamp_ns();
                n_after_restart += u32::from(second.is_some());
                if frame.header().sequence >= 2 && first.take().is_some() {
                    killed = Some(Instant::now());
                }
            }
            InputEvent::CameraGone { .. } => {
                told_after = killed.map(|killed| killed.elapsed());
                second = Some(camera(recording.path(), &service, &live));
            }
            InputEvent::CameraCame { .. } => (),
            other => panic!("{other:?}"),
        }
    }
    assert!(told_after.is_some_and(|after| after < Duration::from_secs(1)), "{told_after:?}");
    assert_eq!(input.counts().n_restarts, 1);
    assert_eq!(input.camera_state(), CameraState::Sending);
}

fn signal(camera: &CameraChild, name: &str) {
    let status = std::process::Command::new("kill").args([name, &camera.id().to_string()]).status();
    assert!(status.is_ok_and(|status| status.success()), "kill {name}");
}

#[test]
fn a_stopped_camera_is_silent_and_not_gone() {
    let recording = grey_recording(400);
    let (mut input, service) = open("stopped");
    let camera = camera(recording.path(), &service, &[]);
    while !matches!(input.wait(PATIENCE).expect("shared memory"), InputEvent::Frame(_)) {}
    signal(&camera, "-STOP");
    let (state, silent_for) = loop {
        match input.wait(Duration::from_millis(400)).expect("shared memory") {
            InputEvent::Frame(_) => (),
            InputEvent::Timeout { camera, silent_for } => break (camera, silent_for),
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(state, CameraState::Silent);
    let said = state.describe(&service, silent_for);
    assert!(said.contains("is it stopped"), "{said}");
    signal(&camera, "-CONT");
    let heard = listen(&mut input, |_, _| ());
    assert_eq!((heard.sequences.last(), input.camera_state()), (Some(&399), CameraState::Ended));
}

#[test]
fn an_interrupted_camera_ends_its_stream_and_exits_cleanly() {
    let recording = grey_recording(600);
    let (mut input, service) = open("interrupted");
    let mut camera = camera(recording.path(), &service, &["--live", "--wait-for-tracker", "30"]);
    while !matches!(input.wait(PATIENCE).expect("shared memory"), InputEvent::Frame(_)) {}
    signal(&camera, "-INT");
    let heard = listen(&mut input, |_, _| ());
    assert!(heard.sequences.len() < 500, "{}", heard.sequences.len());
    drop(input);
    assert_eq!(camera.wait(PATIENCE).and_then(|status| status.code()), Some(0));
}

#[test]
fn the_end_is_heard_even_when_the_camera_did_not_wait_for_it() {
    let recording = grey_recording(3);
    let (mut input, service) = open("slow");
    let mut camera = camera(recording.path(), &service, &["--live", "--rate", "100", "--wait-for-tracker", "30"]);
    while !matches!(input.wait(PATIENCE).expect("shared memory"), InputEvent::Frame(_)) {}
    assert!(camera.wait(PATIENCE).is_some());
    listen(&mut input, |_, _| ());
    assert_eq!(input.counts().n_received + input.counts().n_missing, 3);
}

#[test]
fn ping_pong_goes_to_and_fro_and_time_goes_on() {
    let recording = grey_recording(4);
    let (mut input, service) = open("ping-pong");
    let _camera = camera(recording.path(), &service, &["--start", "1", "--ping-pong", "2"]);
    let shown = std::cell::RefCell::new(Vec::new());
    let heard = listen(&mut input, |_, pixels| shown.borrow_mut().push(pixels[0]));
    let frames = [vec![1, 2, 3], vec![3; 10], vec![2, 1]].concat();
    assert_eq!(*shown.borrow(), frames.iter().map(|&index| grey_value(index, 0, 0)).collect::<Vec<u8>>());
    let times: Vec<u64> = (1..16).map(|step| step * 100_000_000).collect();
    assert_eq!(heard.times_ns, times);
}

#[test]
fn a_live_camera_overwrites_the_oldest_and_the_gap_is_counted() {
    let recording = grey_recording(30);
    let (mut input, service) = open("live");
    let _camera = camera(recording.path(), &service, &["--live", "--rate", "10", "--wait-for-tracker", "30"]);
    let mut n_frames = 0;
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                assert_eq!(frame.pixels()[0], grey_value(frame.header().sequence, 0, 0));
                n_frames += 1;
                // Five times as long as the camera takes for a frame.
                std::thread::sleep(Duration::from_millis(50));
            }
            InputEvent::End => break,
            _ => (),
        }
    }
    let counts = input.counts();
    assert_eq!(counts.n_received, n_frames);
    assert_eq!(counts.n_received + counts.n_missing, 30, "{counts:?}");
    assert!(counts.n_missing > 0, "{counts:?}");
}

#[test]
fn an_unreadable_image_is_left_out_and_its_number_is_missing() {
    let recording = grey_recording(6);
    let path = recording.path().join("images/000003.png");
    let bytes = std::fs::read(&path).expect("an image");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("an image");
    let (mut input, service) = open("truncated");
    let _camera = camera(recording.path(), &service, &[]);
    let heard = listen(&mut input, |_, _| ());
    assert_eq!(heard.sequences, [0, 1, 2, 4, 5]);
    assert_eq!((input.counts().n_received, input.counts().n_missing), (5, 1));
}

#[test]
fn a_camera_whose_tracker_goes_away_ends_with_an_error() {
    let recording = grey_recording(50);
    let (mut input, service) = open("tracker-gone");
    let mut camera = camera(recording.path(), &service, &[]);
    while !matches!(input.wait(PATIENCE).expect("shared memory"), InputEvent::Frame(_)) {}
    drop(input);
    assert_eq!(camera.wait(PATIENCE).and_then(|status| status.code()), Some(1));
}

#[test]
fn a_live_camera_outlives_its_tracker_unless_told_otherwise() {
    let check = |more: &[&str], expected_exit_code: Option<i32>| {
        let recording = grey_recording(600);
        let (mut input, service) = open("live-tracker-gone");
        let live = [&["--live", "--wait-for-tracker", "30"], more].concat();
        let mut camera = camera(recording.path(), &service, &live);
        while !matches!(input.wait(PATIENCE).expect("shared memory"), InputEvent::Frame(_)) {}
        drop(input);
        let status = camera.wait(if expected_exit_code.is_some() { PATIENCE } else { Duration::from_millis(500) });
        assert_eq!(status.and_then(|status| status.code()), expected_exit_code);
        if expected_exit_code.is_none() {
            let (mut next, _) = open_at(service);
            while !matches!(next.wait(PATIENCE).expect("shared memory"), InputEvent::Frame(_)) {}
        }
    };
    check(&[], None);
    check(&["--end-with-tracker"], Some(1));
}

#[test]
fn a_camera_without_a_tracker_gives_up() {
    let recording = grey_recording(2);
    let service = unique_service_name("no-tracker");
    let mut camera = camera(recording.path(), &service, &["--wait-for-tracker", "0.2"]);
    assert_eq!(camera.wait(PATIENCE).and_then(|status| status.code()), Some(1));
}

#[test]
fn the_format_is_fixed_by_the_first_frame() {
    let recording = grey_recording(1);
    let (mut input, service) = open("format");
    let _camera = camera(recording.path(), &service, &[]);
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                assert_eq!(frame.pixel_format(), PixelFormat::Mono8);
                let grey = frame.grey().expect("a grey image");
                assert_eq!((grey.width(), grey.height(), grey.row(2)[1]), (48, 32, grey_value(0, 1, 2)));
                break;
            }
            InputEvent::CameraCame { .. } => (),
            other => panic!("{other:?}"),
        }
    }
}
