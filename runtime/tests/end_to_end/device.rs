//! Drives that a device maps: within their plan, refused when a row is too large, and finished when the device is
//! lost half-way. Without a device, each test says that it was left out.

use crate::drive::{Drive, write};
use crate::program::{Ended, Program, kilogs, word};
use crate::replay::{count, json, number};
use serde_json::Value;
use std::path::Path;

const BUDGET: &str = include_str!("../../../memory_budget.toml");

/// When this is `1`, a test that finds no device fails.
const REQUIRE_VARIABLE: &str = "KILOGS_REQUIRE_VULKAN";

/// Exit code of a compute device that cannot be had.
const NO_DEVICE: i32 = 4;

fn has_device(backend: &str) -> bool {
    let ended = kilogs(["budget", "--backend", backend, "--check"]);
    if ended.code == Some(NO_DEVICE) {
        println!("skipped: {}", ended.stderr);
        assert!(std::env::var_os(REQUIRE_VARIABLE).is_none_or(|value| value != "1"), "{REQUIRE_VARIABLE}=1");
        return false;
    }
    assert_eq!(ended.code, Some(0), "the shipped budget holds a device: {}", ended.stderr);
    true
}

/// Runs `kilogs replay --backend BACKEND`, with `lose_after` submissions before a pretended loss.
fn replay(backend: &str, drive: &Drive, out: &Path, options: &[&str], lose_after: Option<u32>) -> Ended {
    let (dataset, out) = (word(drive.path()), word(out));
    let words = ["replay", &dataset, "--out", &out, "--iterations", "2", "--backend", backend];
    let drill = lose_after.map(|n| ("KILOGS_VULKAN_LOSE_AFTER", n.to_string()));
    Program::start_with(words.iter().chain(options), drill).wait()
}

fn text<'a>(report: &'a Value, pointer: &str) -> &'a str {
    report.pointer(pointer).and_then(Value::as_str).unwrap_or_else(|| panic!("{pointer} in {report}"))
}

/// What holds for every run, whatever computed it; only wgpu allocates of its own.
fn check_report(out: &Path, drive: &Drive) -> Value {
    let report = json(&out.join("report.json"));
    assert_eq!(count(&report, "/frames/received") as usize, drive.n_images(), "{report}");
    let used = count(&report, "/memory/rss_peak_bytes") + count(&report, "/memory/camera_rss_peak_bytes");
    // Shared frames are resident in two processes.
    let rows = report.pointer("/memory/plan").and_then(Value::as_array).expect("a plan");
    let planned = rows.iter().map(|row| count(row, "/bytes")).sum::<u64>() + count(&report, "/memory/ipc_bytes");
    println!("{}: {} MiB of {} MiB planned", text(&report, "/backend/device"), used >> 20, planned >> 20);
    assert!(used <= planned.min(count(&report, "/memory/budget_host_bytes")), "{report}");
    assert!(count(&report, "/memory/device_peak_bytes") <= count(&report, "/memory/budget_device_bytes"), "{report}");
    assert!(number(&report, "/mapping/psnr_train_db") > 10.0, "{report}");
    report
}

/// What the log says of the arena, MiB: taken and planned.
fn arena(ended: &Ended) -> [f64; 2] {
    let line = ended.stderr.lines().find(|line| line.contains("an arena of")).unwrap_or_else(|| panic!("{ended:?}"));
    let mut mib = line.split("an arena of").nth(1).expect("figures").split(' ').filter_map(|word| word.parse().ok());
    core::array::from_fn(|_| mib.next().expect("two figures"))
}

#[test]
fn a_drive_through_wgpu_stays_within_its_plan() {
    if !has_device("wgpu") {
        return;
    }
    let drive = Drive::new(6.0);
    let folder = tempfile::tempdir().expect("a folder");
    let ended = replay("wgpu", &drive, folder.path(), &[], None);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    let [taken, planned] = arena(&ended);
    assert!(0.5 * planned < taken && taken <= planned, "an arena of {taken} MiB, {planned} MiB planned");
    assert_eq!(text(&check_report(folder.path(), &drive), "/backend/kind"), "wgpu");
}

#[test]
fn a_drive_on_a_device_stays_within_its_plan_and_survives_its_loss() {
    if has_device("vulkan") {
        check_drives("direct", 12.0);
    }
}

#[test]
fn so_does_a_drive_with_learned_decoders() {
    if has_device("vulkan") {
        check_drives("learned", 6.0);
    }
}

/// A drive that the device finishes, and one that it does not.
fn check_drives(decoder: &str, length_m: f64) {
    let drive = Drive::new(length_m);
    let folder = tempfile::tempdir().expect("a folder");
    let (whole, lost) = (folder.path().join("whole"), folder.path().join("lost"));
    let options = ["--set", &format!("mapping.decoder={decoder}")];
    let ended = replay("vulkan", &drive, &whole, &options, None);
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    let [taken, planned] = arena(&ended);
    assert!(0.5 * planned < taken && taken <= planned, "an arena of {taken} MiB, {planned} MiB planned");
    let report = check_report(&whole, &drive);
    assert_eq!(text(&report, "/backend/kind"), "vulkan");
    assert_eq!(count(&report, "/memory/sealed_allocations"), 0, "{report}");

    let ended = replay("vulkan", &drive, &lost, &options, Some(60));
    assert_eq!(ended.code, Some(0), "{}", ended.stderr);
    assert!(ended.stderr.contains("Mapping goes on with the CPU backend"), "{}", ended.stderr);
    let after_loss = check_report(&lost, &drive);
    assert_eq!(text(&after_loss, "/backend/kind"), "cpu");
    assert_eq!(count(&after_loss, "/memory/sealed_allocations"), 0, "{after_loss}");
    assert!(text(&after_loss, "/backend/device").contains("which failed"), "{after_loss}");
    let odometry = |out: &Path| std::fs::read(out.join("odometry_tum.txt")).expect("an odometry");
    assert!(odometry(&whole) == odometry(&lost), "tracking does not notice");
}

#[test]
fn a_row_too_large_for_the_device_is_refused_by_name() {
    if !has_device("vulkan") {
        return;
    }
    let drive = Drive::new(3.0);
    let folder = tempfile::tempdir().expect("a folder");
    let budget = folder.path().join("budget.toml");
    let refused = |pairs: u64, said: &str| {
        let row = "[splat.pairs]\ncapacity = 1572864";
        assert!(BUDGET.contains(row), "{row} is not in the shipped budget");
        let text = BUDGET.replacen(row, &format!("[splat.pairs]\ncapacity = {pairs}"), 1);
        write(&budget, text.replacen("host_bytes = \"512 MiB\"", "host_bytes = \"1 GiB\"", 1));
        let ended = replay("vulkan", &drive, &folder.path().join("out"), &["--budget", &word(&budget)], None);
        assert!(ended.code == Some(2) && ended.stderr.contains(said), "{said}: {ended:?}");
    };
    refused(200_000_000, "[splat.pairs] takes");
}
