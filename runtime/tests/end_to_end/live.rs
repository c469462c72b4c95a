//! `kilogs run` beside a camera that comes, dies and comes back.

use crate::drive::Drive;
use crate::program::{Program, word};
use crate::replay::{check_counts, count, json};
use std::path::Path;
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
        run.wait_for("the camera process is gone", attempt);
        told_after.push(run.said_after(killed, "the camera process is gone"));
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
    for name in ["trajectory_tum.txt", "odometry_tum.txt", "frames.csv", "report.html", "map/manifest.kgs"] {
        assert!(out.path().join(name).exists(), "{name} is missing: {}", ended.stderr);
    }
}

#[test]
fn a_run_without_any_camera_waits_and_can_be_ended() {
    let (drive, out) = (Drive::new(3.0), tempfile::tempdir().expect("a folder"));
    let mut run = start_run(&drive, &service_name("none"), out.path());
    run.wait_for("waiting for camera frames", 1);
    run.interrupt();
    let ended = run.wait();
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    let report = json(&out.path().join("report.json"));
    assert_eq!(count(&report, "/frames/received"), 0, "{report}");
    assert_eq!(report.pointer("/mapping/psnr_train_db"), Some(&serde_json::Value::Null), "{report}");
    assert!(out.path().join("report.html").exists(), "{}", ended.stderr);
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
