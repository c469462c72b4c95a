//! A whole run, with its capture process, inside a tiny budget: what the plan says is what happens.

use kilogs_camera::ipc::{HEALTH_SERVICE, HealthMessage, create_node, open_messages};
use kilogs_camera::sim::{SimArgs, write_dataset};
use kilogs_camera::source::DegradeArgs;
use kilogs_tests::program::kilogs;
use serde_json::Value;
use std::path::Path;
use std::process::Output;
use std::time::Duration;

/// Small enough for a test, large enough to be tracked.
const SIZE: [u32; 2] = [310, 94];

/// How often the health of a run is looked at; it is published once a second.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// Runs `kilogs replay` on a simulated drive in the tiny profile, and reads its report and what it said about the
/// size of its map store while it ran.
fn replayed(folder: &Path) -> (Value, Vec<u64>) {
    let dataset = folder.join("drive");
    let args = SimArgs { length: 30.0, width: SIZE[0], height: SIZE[1], mono: true, ..SimArgs::default() };
    write_dataset(&args, &DegradeArgs::default(), &dataset, |_, _| ()).expect("a simulated drive");
    let out = folder.join("out");
    let mut command = kilogs();
    command.arg("replay").arg(&dataset).arg("--out").arg(&out);
    command.args(["--budget", "tiny.toml", "--iterations", "2"]);
    let node = create_node("listener").expect("a node");
    let health = open_messages::<HealthMessage>(&node, HEALTH_SERVICE).expect("a service");
    let health = health.subscriber_builder().create().expect("a subscriber");
    let running = std::thread::spawn(move || command.output());
    let mut sizes = Vec::new();
    loop {
        let is_over = running.is_finished();
        while let Some(message) = health.receive().expect("shared memory") {
            sizes.push(message.store_bytes);
        }
        if is_over {
            break;
        }
        std::thread::sleep(LOOK_INTERVAL);
    }
    let output: Output = running.join().expect("no panic").expect("kilogs runs");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report = std::fs::read_to_string(out.join("report.json")).expect("a report");
    (serde_json::from_str(&report).expect("JSON"), sizes)
}

#[test]
fn a_run_stays_within_its_plan_and_its_sealed_threads_take_no_memory() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (report, store_sizes) = replayed(folder.path());
    let number =
        |path: &str| report.pointer(path).and_then(Value::as_u64).unwrap_or_else(|| panic!("{path} in {report}"));
    let frames = ["received", "tracked", "doubtful", "lost", "dropped"].map(|name| number(&format!("/frames/{name}")));
    assert_eq!(frames[0], frames[1..].iter().sum::<u64>(), "every frame is accounted for");
    assert!(frames[1] > 10, "the drive was tracked: {frames:?}");
    assert!(number("/mapping/anchors_total") > 0, "the drive was mapped");

    assert_eq!(number("/memory/sealed_allocations"), 0, "KILOGS_SEAL_TRACE=1 shows where");
    // The last pages are written after the last message; the service belongs to the whole machine.
    let store_bytes = number("/mapping/store_bytes");
    println!("map store: {store_sizes:?}, in the end {store_bytes}");
    let said = store_sizes.iter().filter(|&&size| size <= store_bytes).max().copied().unwrap_or(0);
    assert!(said * 4 > store_bytes, "{store_sizes:?} of {store_bytes}");

    let plan = report.pointer("/memory/plan").and_then(Value::as_array).expect("the plan");
    let planned = |is_wanted: fn(&str) -> bool| -> u64 {
        let name = |row: &Value| row["row"].as_str().unwrap_or_default().to_owned();
        plan.iter().filter(|row| is_wanted(&name(row))).filter_map(|row| row["bytes"].as_u64()).sum()
    };
    let own = number("/memory/rss_peak_bytes");
    let own_plan = planned(|row| row != "process.camera_child");
    assert!(own <= own_plan, "this process took {own} bytes, its plan is {own_plan}");
    let camera = number("/memory/camera_rss_peak_bytes");
    let camera_plan = planned(|row| row == "process.camera_child" || row == "ipc.frame_slots");
    assert!(camera <= camera_plan, "the capture process took {camera} bytes, its plan is {camera_plan}");
    assert!(own + camera <= number("/memory/budget_host_bytes"));
}

#[test]
fn a_budget_that_is_too_small_is_refused_before_anything_starts() {
    let run = |arguments: &[&str]| {
        let output = kilogs().args(arguments).output().expect("kilogs runs");
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    assert_eq!(run(&["budget", "--check", "--budget", "tiny.toml", "--size", "310x94"]).0, Some(0));
    let (code, message) = run(&["budget", "--check", "--budget", "tiny.toml", "--size", "4096x4096"]);
    assert_eq!(code, Some(2), "{message}");
    assert!(message.contains("tiny.toml") && message.contains("[") && message.contains("96 MiB"), "{message}");
}
