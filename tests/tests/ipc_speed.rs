//! Wheel speed from a real capture process: with a frame come the readings up to it, whatever happens to the frames.

use std::path::Path;
use std::time::Duration;

use clap::Parser;
use kilogs::input::{
    CameraChild, Distance, FrameInput, FrameSlots, InputEvent, InputSettings, ServiceFormat, unique_service_name,
};
use kilogs_camera::cli::{CameraArgs, run};
use kilogs_tests::camera::{SIZE, camera_process_arguments, grey_recording, handed_over_arguments};

const PATIENCE: Duration = Duration::from_secs(30);
const N_FRAMES: u64 = 12;

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

/// Per frame: its time, the time of the newest reading, and the way since the frame before.
type Heard = Vec<(u64, Option<u64>, Option<Distance>)>;

fn listen(dataset: &Path, more: &[&str]) -> Heard {
    let service = unique_service_name("speed");
    let settings = InputSettings {
        service: service.clone(),
        format: ServiceFormat { width: SIZE[0], height: SIZE[1], pixel_format: None },
        slots: FrameSlots::DEFAULT,
        is_recorded: true,
        speed_readings: 64,
    };
    let mut input = FrameInput::open(&settings).expect("shared memory");
    let dataset = dataset.display().to_string();
    let arguments = [&["folder", dataset.as_str(), "--service", &service, "--quiet"], more].concat();
    let _camera = CameraChild::start(camera_process_arguments(&arguments)).expect("a camera process");
    let (mut heard, mut previous_ns) = (Heard::new(), None);
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                let (now_ns, speeds) = (frame.timestamp_ns(), frame.speeds());
                let since = previous_ns.and_then(|previous_ns| speeds.between(previous_ns, now_ns));
                heard.push((now_ns, speeds.newest().map(|reading| reading.timestamp_ns), since));
                previous_ns = Some(now_ns);
            }
            InputEvent::CameraCame { .. } => (),
            InputEvent::End => return heard,
            other => panic!("{other:?} in the middle of the stream"),
        }
    }
}

/// Speeds up by 1 m/s in a second, with a reading every 20 ms.
fn wheels() -> String {
    (0..100).map(|i| f64::from(i) * 0.02).map(|t| format!("{t:.3} {} 0.1\n", 3.0 + t)).collect()
}

#[test]
fn with_every_frame_come_the_readings_up_to_it() {
    let recording = grey_recording(N_FRAMES);
    std::fs::write(recording.path().join("speed.txt"), wheels()).expect("a temporary file");
    let heard = listen(recording.path(), &[]);
    assert_eq!(heard.len() as u64, N_FRAMES);
    for (frame, &(now_ns, newest_ns, since)) in heard.iter().enumerate() {
        assert_eq!(newest_ns, Some(now_ns), "frame {frame}");
        let Some(Distance { metres, sigma_m }) = since else {
            assert_eq!(frame, 0, "the first frame alone has none before it");
            continue;
        };
        let expected_m = 0.1 * (3.0 + 0.1 * (frame as f64 - 0.5));
        assert!((metres - expected_m).abs() < 1e-9 && (sigma_m - 0.01).abs() < 1e-9, "{frame}: {metres} {sigma_m}");
    }
    assert_eq!(heard, listen(recording.path(), &[]), "the same twice");
}

#[test]
fn readings_bridge_missing_frames_and_a_part_of_a_recording() {
    let recording = grey_recording(N_FRAMES);
    let wheels_txt = recording.path().join("wheels.txt");
    std::fs::write(&wheels_txt, wheels()).expect("a temporary file");
    let wheels_txt = wheels_txt.display().to_string();
    let heard = listen(recording.path(), &["--start", "2", "--degrade", "gap@3..7", "--speed", &wheels_txt]);
    // Frames 2 to 4 of the recording, then 9.
    let times: Vec<u64> = heard.iter().map(|(now_ns, ..)| now_ns / 100_000_000).collect();
    assert_eq!(times, [2, 3, 4, 9, 10, 11]);
    let way_m = heard[3].2.map(|distance| distance.metres);
    assert!(way_m.is_some_and(|metres| (metres - 0.5 * 3.65).abs() < 1e-9), "{way_m:?}");
    assert!(listen(recording.path(), &[]).iter().all(|(_, newest_ns, since)| newest_ns.is_none() && since.is_none()));
}

#[test]
fn a_speed_file_that_cannot_be_believed_ends_the_camera_with_code_3() {
    let recording = grey_recording(2);
    std::fs::write(recording.path().join("speed.txt"), "0 1 0.1\n0.1 NaN 0.1\n").expect("a temporary file");
    let dataset = recording.path().display().to_string();
    let arguments = ["folder", dataset.as_str(), "--service", &unique_service_name("speed"), "--quiet"];
    let mut camera = CameraChild::start(camera_process_arguments(&arguments)).expect("a camera process");
    assert_eq!(camera.wait(PATIENCE).and_then(|status| status.code()), Some(3));
}
