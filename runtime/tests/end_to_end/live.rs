//! `kilogs run` beside a camera that comes, dies and comes back.

use crate::drive::{Drive, write};
use crate::program::{Program, word};
use crate::replay::{check_counts, count, json, number};
use kilogs_camera::ipc::{FrameSlots, create_node, open_frames};
use kilogs_camera::publish::{Pace, PublishSettings, publish};
use kilogs_camera::source::{FrameInfo, FrameSource, PixelFormat, SourceError, SourceFormat};
use std::path::Path;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, SystemTime};

/// A camera that is gone is told within a second, by the clock of the run itself.
const TOLD_WITHIN: Duration = Duration::from_secs(1);

/// A machine that is busy with other things may miss that once; a program that is too slow misses it always.
const ATTEMPTS: usize = 3;

/// Frames that pass before something happens.
const SOME_FRAMES: Duration = Duration::from_millis(1500);

fn start_camera(drive: &Drive, service: &str) -> Program {
    let dataset = word(drive.path());
    Program::start(["camera", "folder", &dataset, "--live", "--service", service, "--ping-pong", "1000", "--quiet"])
}

fn start_run(drive: &Drive, service: &str, out: &Path) -> Program {
    let (camera, out) = (word(&drive.complete_camera_file()), word(out));
    Program::start(["run", "--service", service, "--camera", &camera, "--out", &out])
}

fn service_name(test: &str) -> String {
    format!("end-to-end-{test}-{}", std::process::id())
}

#[test]
fn a_camera_may_die_and_come_back() {
    let (drive, out, service) = (Drive::new(8.0), tempfile::tempdir().expect("a folder"), service_name("back"));
    let mut run = start_run(&drive, &service, out.path());
    let mut camera = start_camera(&drive, &service);
    run.wait_for("the camera is there", 1);
    let mut told_after = Vec::new();
    for attempt in 1..=ATTEMPTS {
        std::thread::sleep(SOME_FRAMES);
        let killed = SystemTime::now();
        camera.kill();
        run.wait_for("is gone, last frame", attempt);
        told_after.push(run.said_after(killed, "is gone, last frame"));
        camera = start_camera(&drive, &service);
        let back_after = run.wait_for("the camera is back", attempt);
        println!("a camera that is back is told after {:.2} s", back_after.as_secs_f64());
        if told_after.iter().any(|after| *after < TOLD_WITHIN) {
            break;
        }
    }
    println!("a killed camera is told after {told_after:?}");
    assert!(told_after.iter().any(|after| *after < TOLD_WITHIN), "{told_after:?}");
    std::thread::sleep(SOME_FRAMES);
    run.interrupt();
    let ended = run.wait();
    camera.kill();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    let report = json(&out.path().join("report.json"));
    check_counts(&report);
    assert_eq!(count(&report, "/memory/sealed_allocations"), 0, "{report}");
    assert_eq!(count(&report, "/frames/refused"), 0, "{report}");
    // Both cameras together sent for about three seconds.
    let n_seen = count(&report, "/frames/received") - count(&report, "/frames/dropped");
    assert!(n_seen >= 10, "{report}");
    for name in ["trajectory_tum.txt", "odometry_tum.txt", "frames.csv", "views.csv", "report.html", "map/manifest.kgs"]
    {
        assert!(out.path().join(name).exists(), "{name} is missing: {}", ended.stderr);
    }
}

#[test]
fn a_silent_camera_is_told_and_more_slots_than_planned_are_refused() {
    let (drive, out, service) = (Drive::new(8.0), tempfile::tempdir().expect("a folder"), service_name("silent"));
    let mut run = start_run(&drive, &service, out.path());
    let camera = start_camera(&drive, &service);
    run.wait_for("the camera is there", 1);
    std::thread::sleep(SOME_FRAMES);
    camera.stop();
    run.wait_for("lives but has sent nothing for", 1);
    std::thread::sleep(SOME_FRAMES);
    assert_eq!(run.said().matches("has sent nothing").count(), 1, "told once: {}", run.said());
    run.interrupt();
    let ended = run.wait();
    camera.kill();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);

    let service = service_name("slots");
    let node = create_node(&service).expect("a node");
    let _made_by_others = open_frames(&node, &service, &FrameSlots::DEFAULT).expect("a service");
    let budget = out.path().join("budget.toml");
    let planned = include_str!("../../../memory_budget.toml").replacen(
        "[ipc.frame_slots]\ncapacity = 9",
        "[ipc.frame_slots]\ncapacity = 7",
        1,
    );
    write(&budget, planned);
    let camera_file = word(&drive.complete_camera_file());
    let out = word(&out.path().join("slots"));
    let words = ["run", "--service", &service, "--camera", &camera_file, "--out", &out, "--budget", &word(&budget)];
    let ended = Program::start(words).wait();
    let is_told = ended.stderr.contains("made with 9 frame slots") && ended.stderr.contains("plans for 7");
    assert!(ended.code == Some(2) && is_told, "{ended:?}");
}

#[test]
fn a_run_without_any_camera_waits_and_can_be_ended() {
    let (drive, out) = (Drive::new(3.0), tempfile::tempdir().expect("a folder"));
    let mut run = start_run(&drive, &service_name("none"), out.path());
    run.wait_for("waiting for a camera at", 1);
    run.interrupt();
    let ended = run.wait();
    let is_told = ended.stderr.contains("error: tracking the drive: not one frame was tracked; 0 were received");
    assert!(ended.code == Some(1) && is_told, "{ended:?}");
    let report = json(&out.path().join("report.json"));
    assert_eq!(count(&report, "/frames/received"), 0, "{report}");
    assert_eq!(report.pointer("/tracking/scale_source"), Some(&serde_json::Value::Null), "{report}");
    assert_eq!(report.pointer("/mapping/psnr_train_db"), Some(&serde_json::Value::Null), "{report}");
    assert!(out.path().join("report.html").exists(), "{}", ended.stderr);
}

#[test]
fn a_run_that_refuses_every_frame_fails_and_says_what_fits() {
    let (drive, out, service) = (Drive::new(5.0), tempfile::tempdir().expect("a folder"), service_name("size"));
    let camera_file = word(&drive.complete_camera_file());
    let other_size = std::fs::read_to_string(&camera_file).expect("a camera file").replace("416", "1242");
    write(Path::new(&camera_file), other_size);
    let words = ["run", "--service", &service, "--camera", &camera_file, "--out", &word(out.path())];
    let mut run = Program::start(words);
    run.wait_for("waiting for a camera at", 1);
    let camera = start_camera(&drive, &service);
    run.wait_for("a camera message was refused", 3);
    run.interrupt();
    let ended = run.wait();
    camera.kill();
    let is_told = ended.stderr.contains("image of 416x128 px, the camera has 1242x128 px; give --camera");
    assert!(ended.code == Some(1) && is_told, "{ended:?}");
    let report = json(&out.path().join("report.json"));
    assert!(count(&report, "/frames/refused") >= 3 && count(&report, "/frames/received") == 0, "{report}");
}

#[test]
fn a_run_needs_the_whole_camera() {
    let (drive, out) = (Drive::new(3.0), tempfile::tempdir().expect("a folder"));
    let mounting_only = word(&drive.file("camera.toml"));
    let ended = Program::start(["run", "--service", "none", "--camera", &mounting_only, "--out", &word(out.path())]);
    let ended = ended.wait();
    let is_told = ended.stderr.contains("a live camera needs width, height, fx, fy, cx and cy");
    assert!(ended.code == Some(2) && is_told, "{ended:?}");
}

/// A camera that sends a drive as pixels of its own kind.
struct OtherCamera<'drive> {
    drive: &'drive Drive,
    format: SourceFormat,
    next: usize,
}

impl FrameSource for OtherCamera<'_> {
    fn format(&self) -> SourceFormat {
        self.format
    }

    fn next_frame(&mut self, pixels: &mut [u8]) -> Result<Option<FrameInfo>, SourceError> {
        if self.next == self.drive.n_images() {
            return Ok(None);
        }
        let image = image::open(self.drive.image(self.next)).expect("an image of the drive");
        match self.format.pixel_format {
            PixelFormat::Mono8 => pixels.copy_from_slice(image.to_luma8().as_raw()),
            PixelFormat::Bgr8 => {
                pixels.copy_from_slice(image.to_rgb8().as_raw());
                pixels.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2));
            }
            other => panic!("no drive is sent as {other:?}"),
        }
        let timestamp_ns = self.next as u64 * 100_000_000;
        self.next += 1;
        Ok(Some(FrameInfo { timestamp_ns, exposure_us: 0 }))
    }
}

/// Maps the drive of a camera that sends `pixel_format`; the stored images must be those of the drive.
fn check_camera(drive: &Drive, pixel_format: PixelFormat) {
    let (out, service) = (tempfile::tempdir().expect("a folder"), service_name(&format!("{pixel_format:?}")));
    let run = start_run(drive, &service, out.path());
    let described = kilogs_camera::source::describe(drive.path(), None, None).expect("the drive");
    let format = SourceFormat { pixel_format, ..described.format };
    let settings = PublishSettings {
        service,
        pace: Pace::Live { rate: 1.0 },
        tracker_patience: Some(Duration::from_secs(60)),
        ends_with_tracker: true,
        slots: FrameSlots::DEFAULT,
        camera_id: 0,
    };
    let mut camera = OtherCamera { drive, format, next: 0 };
    let sent = publish(&mut camera, &settings, &AtomicBool::new(false), &mut |_| ()).expect("a tracker listens");
    let ended = run.wait();
    assert_eq!((ended.code, sent.n_sent), (Some(0), drive.n_images() as u64), "{}", ended.stderr);
    let report = json(&out.path().join("report.json"));
    check_counts(&report);
    let psnr_db = number(&report, "/mapping/psnr_train_db");
    println!("{pixel_format:?}: PSNR on keyframes {psnr_db:.2} dB");
    assert!((11.0..50.0).contains(&psnr_db) && count(&report, "/mapping/gaussians") > 1000, "{report}");
    let mut n_stored = 0;
    for index in 0..drive.n_images() {
        let Ok(stored) = image::open(out.path().join(format!("map/images/{index:08}.jpg"))) else { continue };
        let sent = image::open(drive.image(index)).expect("an image of the drive");
        let sent = if pixel_format == PixelFormat::Mono8 { sent.grayscale() } else { sent };
        let (stored, sent) = (stored.to_rgb8(), sent.to_rgb8());
        let differences = stored.as_raw().iter().zip(sent.as_raw()).map(|(a, b)| u64::from(a.abs_diff(*b)));
        let mean = differences.sum::<u64>() as f64 / sent.as_raw().len() as f64;
        assert!(mean < 8.0, "{pixel_format:?}: frame {index} is stored {mean:.1} levels beside what was sent");
        n_stored += 1;
    }
    assert!(n_stored >= 2, "{pixel_format:?}: {n_stored} images are stored: {}", ended.stderr);
}

#[test]
fn a_camera_without_rgb_pixels_is_mapped_too() {
    let drive = Drive::new(15.0);
    check_camera(&drive, PixelFormat::Mono8);
    check_camera(&drive, PixelFormat::Bgr8);
}
