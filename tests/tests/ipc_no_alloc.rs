//! Waiting for, judging, looking at, acknowledging and giving back a frame takes nothing from the heap.

use std::time::Duration;

use clap::Parser;
use kilogs::input::{
    CameraChild, FrameInput, FrameSlots, InputEvent, InputSettings, ServiceFormat, unique_service_name,
};
use kilogs::output::{HealthPublisher, OdometryPublisher};
use kilogs::seal;
use kilogs_camera::cli::{CameraArgs, run};
use kilogs_camera::ipc::{
    HEALTH_SERVICE, HealthMessage, ODOMETRY_SERVICE, OdometryMessage, create_node, open_messages,
};
use kilogs_tests::camera::{SIZE, camera_process_arguments, grey_recording, handed_over_arguments};

#[global_allocator]
static ALLOCATOR: seal::CountingAllocator = seal::CountingAllocator;

const PATIENCE: Duration = Duration::from_secs(30);
const WARM_UP_FRAMES: u64 = 5;
const N_FRAMES: u64 = 60;

/// Not a test of its own: the camera process of the other test.
#[test]
#[ignore = "runs as the camera process of the other test"]
fn acts_as_camera() {
    let Some(arguments) = handed_over_arguments() else { return };
    let args = CameraArgs::parse_from(["kilogs-camera".to_owned()].into_iter().chain(arguments));
    assert!(run(&args).is_ok());
}

#[test]
fn a_frame_from_camera_to_acknowledgement_allocates_nothing() {
    let recording = grey_recording(N_FRAMES);
    let wheels: String = (0..6 * N_FRAMES).map(|i| format!("{:.3} 5 0.1\n", i as f64 / 50.0)).collect();
    std::fs::write(recording.path().join("speed.txt"), wheels).expect("a temporary file");
    let service = unique_service_name("no-alloc");
    let format = ServiceFormat { width: SIZE[0], height: SIZE[1], pixel_format: None };
    let settings = InputSettings {
        service: service.clone(),
        format,
        slots: FrameSlots::DEFAULT,
        is_recorded: false,
        speed_readings: 64,
    };
    let mut input = FrameInput::open(&settings).expect("shared memory");
    let dataset = recording.path().display().to_string();
    let arguments = ["folder", &dataset, "--service", &service, "--quiet"];
    let _camera = CameraChild::start(camera_process_arguments(&arguments)).expect("a camera process");
    let mut sealed = None;
    let mut sum = 0_u64;
    loop {
        match input.wait(PATIENCE).expect("shared memory") {
            InputEvent::Frame(frame) => {
                let now_ns = frame.timestamp_ns();
                let way = frame.speeds().between(now_ns.saturating_sub(100_000_000), now_ns);
                assert_eq!(way.is_some(), frame.header().sequence > 0, "the ring has 64 readings, six per frame");
                sum += frame.pixels().iter().map(|&value| u64::from(value)).sum::<u64>();
                if frame.header().sequence == WARM_UP_FRAMES {
                    sealed = Some(seal::enter());
                }
            }
            InputEvent::End => break,
            _ => (),
        }
    }
    let violations = sealed.map(|sealed| sealed.violations());
    assert_eq!(violations, Some((0, 0)), "allocations and frees in {} frames", N_FRAMES - WARM_UP_FRAMES);
    assert_eq!(input.counts().n_received, N_FRAMES);
    assert!(sum > 0);
}

#[test]
fn odometry_and_health_reach_whoever_listens() {
    let node = create_node("listener").expect("a node");
    let odometry = open_messages::<OdometryMessage>(&node, ODOMETRY_SERVICE).expect("a service");
    let odometry = odometry.subscriber_builder().create().expect("a subscriber");
    let health = open_messages::<HealthMessage>(&node, HEALTH_SERVICE).expect("a service");
    let health = health.subscriber_builder().create().expect("a subscriber");
    // A number that no other run publishes, for these names belong to the whole machine.
    let ours = u64::from(std::process::id()) << 32;
    let (speaks, reports) = (OdometryPublisher::open(), HealthPublisher::open());
    let (speaks, reports) = (speaks.expect("shared memory"), reports.expect("shared memory"));
    speaks.publish(&odometry_message(ours)).expect("shared memory");
    reports.publish(&health_message(ours)).expect("shared memory");
    let mut sequences = std::iter::from_fn(|| odometry.receive().expect("shared memory")).map(|m| m.sequence);
    assert!(sequences.any(|sequence| sequence == ours));
    let mut sizes = std::iter::from_fn(|| health.receive().expect("shared memory")).map(|m| m.rss_bytes);
    assert!(sizes.any(|rss_bytes| rss_bytes == ours));
}

fn odometry_message(sequence: u64) -> OdometryMessage {
    OdometryMessage { sequence, ..OdometryMessage::default() }
}

fn health_message(rss_bytes: u64) -> HealthMessage {
    HealthMessage { rss_bytes, ..HealthMessage::default() }
}
