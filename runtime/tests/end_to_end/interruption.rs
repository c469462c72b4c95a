//! Replays that do not come to their end.

use crate::drive::Drive;
use crate::program::{Ended, Program, word};
use crate::replay::{check_counts, count, json, number};
use std::path::Path;

/// Starts a replay that lasts, and lets it receive some frames.
fn start(drive: &Drive, out: &Path, options: &[&str]) -> Program {
    let (dataset, folder) = (word(drive.path()), word(out));
    let words = ["replay", &dataset, "--out", &folder, "--ping-pong", "1000"];
    let mut program = Program::start(words.iter().chain(options));
    program.wait_for("the camera is there", 1);
    std::thread::sleep(std::time::Duration::from_secs(1));
    program
}

/// What was done until then is written.
fn check(out: &Path, ended: &Ended, code: i32, said: &str) {
    assert!(ended.code == Some(code) && ended.stderr.contains(said), "not {code} and \"{said}\": {ended:?}");
    let report = json(&out.join("report.json"));
    check_counts(&report);
    assert!(count(&report, "/frames/received") > 0, "{report}");
    for name in ["trajectory_tum.txt", "report.html", "map/manifest.kgs"] {
        assert!(out.join(name).exists(), "{name} is missing: {}", ended.stderr);
    }
}

#[test]
fn an_interrupted_replay_is_a_short_one() {
    let (drive, out) = (Drive::new(5.0), tempfile::tempdir().expect("a folder"));
    for options in [&["--iterations", "1"][..], &["--live", "--rate", "0.5"]] {
        let program = start(&drive, out.path(), options);
        program.interrupt();
        check(out.path(), &program.wait(), 0, "outputs in");
    }
}

#[test]
fn an_interrupted_demo_judges_what_it_drove() {
    let out = tempfile::tempdir().expect("a folder");
    let mut program = Program::start(["demo", "--iterations", "1", "--out", &word(out.path())]);
    program.wait_for("the camera is there", 1);
    std::thread::sleep(std::time::Duration::from_secs(3));
    program.interrupt();
    check(out.path(), &program.wait(), 0, "outputs in");
    let eval = json(&out.path().join("eval.json"));
    assert!(number(&eval, "/ate_se3_m") < 1.0, "{eval}");
}

#[test]
fn a_replay_whose_capture_process_dies_ends_and_says_so() {
    let (drive, out) = (Drive::new(5.0), tempfile::tempdir().expect("a folder"));
    for options in [&["--iterations", "1"][..], &["--live", "--rate", "0.5"]] {
        let program = start(&drive, out.path(), options);
        program.kill_child();
        check(out.path(), &program.wait(), 1, "the camera process failed (signal: 9");
    }
}
