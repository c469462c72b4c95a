//! Inputs that cannot be used: each ends with its exit code and says what is wrong, or is left out and counted.

use crate::drive::{Drive, SIZE, write};
use crate::program::{kilogs, kilogs_succeeds, word};
use crate::replay::{check_counts, count, json};
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const BUDGET: &str = include_str!("../../../memory_budget.toml");

/// Runs a command that must end with `code` and say `text`.
fn check(words: &[&str], code: i32, text: &str) {
    let ended = kilogs(words);
    let said = ended.stderr.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(ended.code == Some(code) && said.contains(text), "{words:?}: not {code} and \"{text}\": {ended:?}");
    assert!(!said.contains("panicked"), "{words:?}: {said}");
}

/// What a replay says to a drive after `spoil`.
fn check_drive(good: &Drive, spoil: impl FnOnce(&Drive), options: &[&str], code: i32, text: &str) {
    let (drive, out) = (good.copy(), tempfile::tempdir().expect("a folder"));
    spoil(&drive);
    let (dataset, out) = (word(drive.path()), word(&out.path().join("run")));
    check(&[&["replay", &dataset, "--out", &out, "--iterations", "1"], options].concat(), code, text);
}

fn remove(path: PathBuf) {
    if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) }.expect("it was there");
}

/// Keeps the header of an image and half of its pixels.
fn truncate(path: &Path) {
    let bytes = std::fs::read(path).expect("an image");
    write(path, &bytes[..bytes.len() / 2]);
}

/// Puts another line `n` (from 1) into the times.
fn set_time(drive: &Drive, n: usize, line: &str) {
    let times = std::fs::read_to_string(drive.file("times.txt")).expect("times");
    let mut lines: Vec<&str> = times.lines().collect();
    lines[n - 1] = line;
    write(&drive.file("times.txt"), lines.join("\n"));
}

#[test]
fn a_recording_that_cannot_be_played_is_refused() {
    let good = Drive::new(3.0);
    let refused = |spoil: &dyn Fn(&Drive), code, text| check_drive(&good, spoil, &[], code, text);
    refused(&|drive| remove(drive.path().to_owned()), 3, "there is no such folder");
    refused(&|drive| remove(drive.file("images")), 3, "has no image_0, image_2 or images");
    let no_images = |drive: &Drive| {
        remove(drive.file("images"));
        write(&drive.file("images/readme.txt"), "nothing");
    };
    refused(&no_images, 3, "has no .png or .jpg images");
    refused(&|drive| remove(drive.file("calib.txt")), 3, "a recording needs a calib.txt");
    refused(&|drive| write(&drive.file("calib.txt"), "P0: 1 2 3\n"), 3, "has 3 numbers, 12 are needed");
    refused(&|drive| remove(drive.file("camera.toml")), 2, "height over the road is unknown");
    refused(&|drive| write(&drive.file("camera.toml"), "height = 1.65\n"), 3, "camera.toml");
    refused(&|drive| remove(drive.file("times.txt")), 3, "--fps");
    refused(&|drive| set_time(drive, 3, "0.05"), 3, "line 3: time goes backwards");
    refused(&|drive| set_time(drive, 2, "NaN"), 3, "line 2: NaN s is not a time");
    check_drive(&good, |_| (), &["--fps", "0"], 2, "--fps 0 is not a frame rate");
    check_drive(&good, |_| (), &["--ping-pong", "0"], 2, "--ping-pong");
    check_drive(&good, |_| (), &["--live", "--rate=-1"], 2, "--rate");
    check_drive(&good, |_| (), &["--camera", "no_such.toml"], 2, "no_such.toml");
}

#[test]
fn a_capture_process_that_fails_at_once_ends_the_run() {
    let good = Drive::new(3.0);
    // Both pass the look that is taken at the recording before the run.
    let truncate_all = |drive: &Drive| (0..drive.n_images()).for_each(|index| truncate(&drive.image(index)));
    check_drive(&good, truncate_all, &[], 3, "the camera process failed");
    check_drive(&good, truncate_all, &[], 3, "frames could be read");
    check_drive(&good, |_| (), &["--start", "1000"], 2, "frames leaves none");
}

#[test]
fn frames_that_cannot_be_read_are_left_out_and_counted() {
    let (drive, out) = (Drive::new(10.0), tempfile::tempdir().expect("a folder"));
    let out = out.path().join("run");
    truncate(&drive.image(3));
    let [width, height] = SIZE;
    image::RgbImage::new(width / 2, height).save(drive.image(5)).expect("an image");
    // The times are not needed where the rate is given.
    remove(drive.file("times.txt"));
    let (dataset, folder) = (word(drive.path()), word(&out));
    let ended = kilogs_succeeds(["replay", &dataset, "--out", &folder, "--iterations", "1", "--fps", "10"]);
    for said in ["000003.png", "000005.png", "208x128 px, the recording 416x128 px"] {
        assert!(ended.stderr.contains(said), "{said} in {}", ended.stderr);
    }
    let report = json(&out.join("report.json"));
    check_counts(&report);
    assert_eq!(count(&report, "/frames/received"), drive.n_images() as u64, "{report}");
    assert_eq!(count(&report, "/frames/dropped"), 2, "{report}");
    let csv = std::fs::read_to_string(out.join("frames.csv")).expect("frames.csv");
    let is_dropped = |row: &&str| row.split(',').nth(2) == Some("dropped");
    let dropped: Vec<&str> = csv.lines().filter(is_dropped).filter_map(|row| row.split(',').next()).collect();
    assert_eq!(dropped, ["3", "5"]);
    check_map_commands(&out);
}

/// Commands on a map: a missing one, a damaged one, and views from nowhere.
fn check_map_commands(run: &Path) {
    let scratch = tempfile::tempdir().expect("a folder");
    let path = |name: &str| word(&scratch.path().join(name));
    let (map, ply, views) = (word(&run.join("map")), path("street.ply"), path("views"));
    check(&["export", &path("nowhere"), "--ply", &ply], 5, "is this the folder that holds manifest.kgs?");
    check(&["export", &map, "--ply", &path("no/such/folder/street.ply")], 1, "check that its folder exists");
    check(&["export", &map, "--spz", &path("no/such/folder/street.spz")], 1, "check that its folder exists");
    let tum = word(&run.join("keyframes_tum.txt"));
    check(&["render", &path("nowhere"), "--trajectory", &tum, "--out", &views], 5, "manifest.kgs");
    let csv = word(&run.join("frames.csv"));
    check(&["render", &map, "--trajectory", &csv, "--out", &views], 3, "frames.csv: line 1");
    check(&["render", &map, "--trajectory", &path("nowhere"), "--out", &views], 3, "reading");
    check(&["eval", &path("nowhere"), "--gt", &tum], 3, "did the run finish?");
    std::fs::create_dir(run.join("eval.json")).expect("a folder");
    let kitti = word(&run.join("trajectory_kitti.txt"));
    check(&["eval", &word(run), "--gt", &kitti], 1, "check free space and permissions");
    let manifest = run.join("map/manifest.kgs");
    let mut bytes = std::fs::read(&manifest).expect("a manifest");
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    write(&manifest, bytes);
    check(&["export", &map, "--ply", &ply], 5, "restore the file from a copy");
    assert!(!Path::new(&ply).exists(), "half an export is left");
}

#[test]
fn settings_and_options_that_cannot_be_used_are_refused() {
    let good = Drive::new(3.0);
    let refused = |options: &[&str], code, text| check_drive(&good, |_| (), options, code, text);
    refused(&["--set", "tracking.no_such=1"], 2, "there is no setting tracking.no_such");
    refused(&["--set", "mapping.resolution=7"], 2, "mapping.resolution = 7: not in the range");
    refused(&["--set", "mapping.resolution"], 2, "--set");
    refused(&["--config", "no_such.toml"], 2, "check the path given with --config");
    refused(&["--backend", "vulkan", "--device", "999"], 4, "--backend cpu needs none");
    refused(&["--backend", "cpu", "--device", "0"], 2, "--device chooses among Vulkan devices");
    refused(&["--threads", "0"], 2, "--threads");
    refused(&["--no-such-option"], 2, "--no-such-option");
    let run = |service, camera, text| check(&["run", "--service", service, "--camera", camera, "--out", "x"], 2, text);
    run("", "camera.toml", "use letters, digits");
    run("bad name!", "camera.toml", "use letters, digits");
    run("front", "kitti", "give --camera a camera.toml with width, height");
    check(&["camera", "sim", "--length", "2", "--write", "/proc/no"], 1, "or name another folder");
    check(&["demo", "--length", "inf"], 2, "not a number above 0");
    check(&["demo", "--length", "1e9"], 2, "the longest drive");

    let file = tempfile::NamedTempFile::new().expect("a file");
    let out = word(&file.path().join("run"));
    check(&["replay", &word(good.path()), "--out", &out], 1, "name another one with --out");
}

#[test]
fn a_budget_that_cannot_be_kept_is_refused() {
    let good = Drive::new(3.0);
    let folder = TempDir::new().expect("a folder");
    let path = folder.path().join("budget.toml");
    let refused = |from: &str, to: &str, text: &str| {
        assert!(BUDGET.contains(from), "{from} is not in the shipped budget");
        write(&path, BUDGET.replacen(from, to, 1));
        check_drive(&good, |_| (), &["--budget", &word(&path)], 2, text);
    };
    const TRACKS: &str = "[tracking.tracks]\ncapacity = 2048";
    refused(TRACKS, "[tracking.tracks]\ncolour = 3\ncapacity = 2048", "[tracking.tracks] unknown key \"colour\"");
    refused(TRACKS, "[tracking.tracks]\ncapacity = 0", "[tracking.tracks] capacity is zero");
    refused(TRACKS, "[tracking.tracks]\ncapacity = -5", "[tracking.tracks] capacity -5 is negative");
    refused(TRACKS, "[tracking.tracks]", "[tracking.tracks] capacity is missing");
    refused("host_bytes = \"512 MiB\"", "host_bytes = \"64 MiB\"", "lowering it is not enough");
    refused("[total]", "[total", "not valid TOML");
    check_drive(&good, |_| (), &["--budget", "no_such.toml"], 2, "give another with --budget FILE");
}

/// A run that fails with `code` and says `text`; it leaves its trajectory and a report without figures of the map.
fn check_outputs_in_spite(drive: &Drive, out: &Path, options: &[&str], code: i32, text: &str) -> serde_json::Value {
    let words = ["replay", &word(drive.path()), "--out", &word(out), "--iterations", "1"];
    check(&[&words, options].concat(), code, text);
    let trajectory = std::fs::read_to_string(out.join("trajectory_tum.txt")).expect("a trajectory");
    assert!(trajectory.lines().count() > 0, "{text}: {trajectory}");
    assert!(out.join("report.html").exists(), "{text}");
    json(&out.join("report.json"))
}

#[test]
fn a_run_that_fails_at_the_end_leaves_what_it_has() {
    // More views than the smallest table holds.
    let (drive, folder) = (Drive::new(90.0), TempDir::new().expect("a folder"));
    let [small, full] = ["small", "full"].map(|name| folder.path().join(name));

    let budget = folder.path().join("budget.toml");
    let row = "[store.keyframe_table]\ncapacity = 32768";
    assert!(BUDGET.contains(row));
    write(&budget, BUDGET.replacen(row, "[store.keyframe_table]\ncapacity = 64", 1));
    let options = ["--budget", &word(&budget)];
    let report = check_outputs_in_spite(&drive, &small, &options, 5, "[store.keyframe_table]");
    assert_eq!(report.pointer("/mapping/psnr_train_db"), Some(&serde_json::Value::Null), "{report}");
    assert!(count(&report, "/memory/refusals") > 0 && count(&report, "/mapping/gaussians") > 0, "{report}");

    std::fs::create_dir(&full).expect("a folder");
    std::os::unix::fs::symlink("/dev/full", full.join("frames.csv")).expect("a link");
    check_outputs_in_spite(&drive, &full, &[], 1, "frames.csv");
}

/// Exit code of a command in a folder.
fn code_in(folder: &Path, words: &[&str]) -> Option<i32> {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_kilogs"));
    let ended = command.args(words).current_dir(folder).output().expect("it starts");
    ended.status.code()
}

#[test]
fn the_budget_file_of_the_current_folder_counts() {
    let folder = tempfile::tempdir().expect("a folder");
    assert_eq!(code_in(folder.path(), &["budget", "--check"]), Some(0), "the built-in one");
    write(&folder.path().join("memory_budget.toml"), BUDGET.replace("512 MiB", "64 MiB"));
    assert_eq!(code_in(folder.path(), &["budget", "--check"]), Some(2));
    assert_eq!(code_in(folder.path(), &["budget", "--check", "--budget", "1080p-2gib.toml"]), Some(0));
}

#[test]
fn a_result_that_cannot_be_written_is_an_error() {
    let status = |shell: &str| {
        let line = shell.replace("KILOGS", env!("CARGO_BIN_EXE_kilogs"));
        std::process::Command::new("sh").args(["-c", &line]).status().expect("a shell").code()
    };
    assert_eq!(status("KILOGS budget > /dev/full 2> /dev/null"), Some(1));
}
