//! A replay from its first frame to its figures.

use crate::drive::{Drive, files};
use crate::program::{kilogs_succeeds, word};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// How much the metric scale of a drive of 30 m may be wrong: the road is seen in three frames out of four, and the
/// first meters have few.
const SCALE_TOLERANCE: f64 = 0.10;

/// Rows whose bytes stand in another row, or cannot be told from the rest of the process.
const NOT_OBSERVED: [&str; 7] = [
    "map.gaussians_per_anchor",
    "loops.points",
    // No memory while no step looks at depth.
    "map.keyframe_depths",
    // No memory without trained networks.
    "inference.arena",
    "store.page_anchors",
    "process.code_and_stacks",
    "process.compute_driver",
];

/// Rows of what is only there for when tracks break, for streets that are seen again, or for data that this drive has none of.
const RESTS_ON_A_GOOD_DRIVE: [&str; 4] =
    ["tracking.features", "tracking.dense_matchers", "tracking.speed_readings", "store.returning_pages"];

/// Runs `kilogs replay`.
fn replay(drive: &Drive, out: &Path, n_threads: usize) {
    let threads = n_threads.to_string();
    let (dataset, out) = (word(drive.path()), word(out));
    kilogs_succeeds(["replay", &dataset, "--out", &out, "--iterations", "2", "--threads", &threads]);
}

#[test]
fn a_replay_writes_every_file_and_the_same_bytes_again() {
    let drive = Drive::new(30.0);
    let out = tempfile::tempdir().expect("a folder");
    let outs = ["one", "two", "blind"].map(|name| out.path().join(name));
    replay(&drive, &outs[0], 1);
    check_outputs(&outs[0], drive.n_images());

    replay(&drive, &outs[1], 2);
    check_same(&outs[0], &outs[1]);
    // What is not there cannot have been used.
    let blind = drive.copy();
    assert!(!blind.file("poses.txt").exists() && !blind.file("depth").exists());
    replay(&blind, &outs[2], 1);
    check_same(&outs[0], &outs[2]);

    let truth = word(&drive.file("poses.txt"));
    kilogs_succeeds(["eval", &word(&outs[0]), "--gt", &truth]);
    let eval = json(&outs[0].join("eval.json"));
    let (ate_m, scale) = (number(&eval, "/ate_se3_m"), number(&eval, "/scale"));
    println!("30 m drive: ATE {ate_m:.3} m, scale {scale:.4}");
    assert!((scale - 1.0).abs() < SCALE_TOLERANCE, "{eval}");
    assert!(ate_m.is_finite() && ate_m < 30.0 * SCALE_TOLERANCE, "{eval}");

    let (map, tum) = (word(&outs[0].join("map")), word(&outs[0].join("keyframes_tum.txt")));
    let (views, ply) = (out.path().join("views"), out.path().join("street.ply"));
    kilogs_succeeds(["render", &map, "--trajectory", &tum, "--out", &word(&views)]);
    let report = json(&outs[0].join("report.json"));
    assert_eq!(files(&views).len() as u64, count(&report, "/frames/keyframes"));
    kilogs_succeeds(["export", &map, "--ply", &word(&ply), "--all-levels"]);
    let header = format!("element vertex {}", count(&report, "/mapping/gaussians"));
    let bytes = std::fs::read(&ply).expect("the export");
    let text = String::from_utf8_lossy(&bytes[..bytes.len().min(200)]).into_owned();
    assert!(text.contains(&header), "{header} in {text}");
}

/// Frames in the dark are found by matches, on memory that was there before.
#[test]
fn matches_in_a_tunnel_take_no_memory() {
    let drive = Drive::new(50.0);
    let out = tempfile::tempdir().expect("a folder");
    let (dataset, folder) = (word(drive.path()), word(out.path()));
    let spoilt = ["--degrade", "tunnel@20..45", "--set", "mapping.enabled=false"];
    kilogs_succeeds(["replay", &dataset, "--out", &folder].iter().chain(&spoilt));
    let report = json(&out.path().join("report.json"));
    assert_eq!(count(&report, "/memory/sealed_allocations"), 0);
    let frames = std::fs::read_to_string(out.path().join("frames.csv")).expect("frames");
    let n_matched = frames.lines().filter(|row| row.contains(",sparse,") || row.contains(",dense,")).count();
    println!("{n_matched} frames by matches, {} lost", count(&report, "/frames/lost"));
    assert!(n_matched > 0, "{frames}");
}

/// Every file of an output folder, and what it says about itself.
fn check_outputs(out: &Path, n_images: usize) {
    let written = files(out);
    let names: Vec<String> = written.keys().map(|name| name.display().to_string()).collect();
    let one_each = ["trajectory_tum.txt", "keyframes_tum.txt", "trajectory_kitti.txt", "odometry_tum.txt"];
    for name in one_each.into_iter().chain(["frames.csv", "report.json", "report.html", "map/manifest.kgs"]) {
        assert!(names.iter().any(|found| found == name), "{name} is missing in {names:?}");
    }
    for folder in ["renders/", "map/pages/", "map/chunks/", "map/images/"] {
        assert!(names.iter().any(|name| name.starts_with(folder)), "nothing in {folder}: {names:?}");
    }
    let leftover = names.iter().find(|name| name.starts_with('.') || name.contains("/.") || name.ends_with("tmp"));
    assert_eq!(leftover, None, "a temporary file is left");

    let report = json(&out.join("report.json"));
    let frames = |name: &str| count(&report, &format!("/frames/{name}"));
    assert_eq!(frames("received"), n_images as u64);
    check_counts(&report);
    assert_eq!((frames("dropped"), frames("refused")), (0, 0), "{report}");
    assert!(frames("tracked") * 10 >= frames("received") * 9, "a clean street is tracked: {report}");
    check_trajectories(out, &report);
    check_memory(&report);
    let psnr_db = number(&report, "/mapping/psnr_train_db");
    println!("{} frames, PSNR on keyframes {psnr_db:.2} dB", frames("received"));
    // A grey picture has about 11 dB; 50 dB is the camera's noise.
    assert!((11.0..50.0).contains(&psnr_db), "{report}");
    assert!(count(&report, "/mapping/gaussians") > 1000, "{report}");
}

/// What contracts.md says about the counts of frames.
pub fn check_counts(report: &Value) {
    let frames = |name: &str| count(report, &format!("/frames/{name}"));
    let in_all = frames("tracked") + frames("doubtful") + frames("lost") + frames("dropped");
    assert_eq!(frames("received"), in_all, "{report}");
    assert!(frames("keyframes") <= frames("tracked"), "{report}");
}

/// Every frame with a pose is in the trajectories, and no other.
fn check_trajectories(out: &Path, report: &Value) {
    let text = |name: &str| std::fs::read_to_string(out.join(name)).expect("a text file");
    let csv = text("frames.csv");
    let with_pose = |row: &&str| ["tracked", "doubtful"].contains(&column(&csv, row, "status"));
    let times_of_frames: Vec<&str> = csv.lines().skip(1).filter(with_pose).map(|row| column(&csv, row, "t")).collect();
    assert_eq!(csv.lines().count() as u64 - 1, count(report, "/frames/received"));
    for name in ["trajectory_tum.txt", "odometry_tum.txt"] {
        let trajectory = text(name);
        let times: Vec<&str> = trajectory.lines().filter_map(|line| line.split(' ').next()).collect();
        assert_eq!(times, times_of_frames, "{name}");
        assert!(trajectory.split_whitespace().all(|word| word.parse::<f64>().is_ok_and(f64::is_finite)), "{name}");
    }
    assert_eq!(text("trajectory_kitti.txt").lines().count(), times_of_frames.len());
    assert_eq!(text("keyframes_tum.txt").lines().count() as u64, count(report, "/frames/keyframes"));
}

/// The cell of `row` under `name`.
fn column<'csv>(csv: &str, row: &'csv str, name: &str) -> &'csv str {
    let header = csv.lines().next().expect("a header");
    let at = header.split(',').position(|column| column == name);
    row.split(',').nth(at.expect("a known column")).expect("a cell in every column")
}

/// Nothing took more than it was granted.
fn check_memory(report: &Value) {
    let memory = |name: &str| count(report, &format!("/memory/{name}"));
    assert_eq!(memory("sealed_allocations"), 0, "{report}");
    let (own, camera, cap) = (memory("rss_peak_bytes"), memory("camera_rss_peak_bytes"), memory("budget_host_bytes"));
    println!("resident: {} of {} MiB, {} MiB of them the camera's", (own + camera) >> 20, cap >> 20, camera >> 20);
    assert!(own > 0 && camera > 0 && own + camera <= cap, "{own} + {camera} of {cap}");
    let plan = report.pointer("/memory/plan").and_then(Value::as_array).expect("a plan");
    assert!(plan.len() > 10, "{report}");
    for row in plan {
        let name = row.pointer("/row").and_then(Value::as_str).expect("a name");
        if NOT_OBSERVED.contains(&name) {
            assert_eq!(row.pointer("/used_peak"), Some(&Value::Null), "{row}");
            continue;
        }
        let used = count(row, "/used_peak");
        assert!((used > 0 || RESTS_ON_A_GOOD_DRIVE.contains(&name)) && used <= count(row, "/bytes"), "{row}");
    }
    // Whatever is filled by degrees is neither empty nor full after 30 m.
    for name in ["tracking.tracks", "tracking.landmarks", "map.anchors", "map.voxels", "store.keyframe_table"] {
        let row = plan.iter().find(|row| row.pointer("/row").and_then(Value::as_str) == Some(name)).expect("a row");
        assert!(count(row, "/used_peak") < count(row, "/bytes"), "{row}");
    }
}

/// Two runs wrote the same, apart from what a clock says.
pub fn check_same(one: &Path, other: &Path) {
    for folder in ["map", "renders"] {
        let (first, second) = (files(&one.join(folder)), files(&other.join(folder)));
        assert!(!first.is_empty(), "{folder}");
        assert_eq!(first.keys().collect::<Vec<_>>(), second.keys().collect::<Vec<_>>(), "{folder}");
        for (name, bytes) in &first {
            assert!(*bytes == second[name], "{}/{} differs in {}", folder, name.display(), other.display());
        }
    }
    for name in ["trajectory_tum.txt", "keyframes_tum.txt", "trajectory_kitti.txt", "odometry_tum.txt"] {
        let [first, second] = [one, other].map(|out| std::fs::read_to_string(out.join(name)).expect("a trajectory"));
        assert_eq!(first, second, "{name}");
    }
    let [first, second] = [one, other].map(|out| without_clock(&out.join("frames.csv")));
    assert_eq!(first, second);
}

/// A table without its columns in milliseconds.
fn without_clock(path: &Path) -> Vec<BTreeMap<String, String>> {
    let csv = std::fs::read_to_string(path).expect("a table");
    let names: Vec<&str> = csv.lines().next().expect("a header").split(',').collect();
    let cells = |row: &str| {
        let named = names.iter().zip(row.split(',')).filter(|(name, _)| !name.ends_with("_ms"));
        named.map(|(name, cell)| ((*name).to_owned(), cell.to_owned())).collect()
    };
    csv.lines().skip(1).map(cells).collect()
}

/// Reads a JSON file.
pub fn json(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

pub fn number(value: &Value, pointer: &str) -> f64 {
    value.pointer(pointer).and_then(Value::as_f64).unwrap_or_else(|| panic!("no number {pointer} in {value}"))
}

/// A whole number of a JSON value.
pub fn count(value: &Value, pointer: &str) -> u64 {
    value.pointer(pointer).and_then(Value::as_u64).unwrap_or_else(|| panic!("no count {pointer} in {value}"))
}
