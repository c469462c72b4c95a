//! The tables that hold the budget to its contract.

use super::*;
use crate::splat::device::Executor as _;
use crate::splat::vulkan::{VulkanExecutor, testing};

const COLOR_KITTI: PlanInput = PlanInput {
    width: 1241,
    height: 376,
    frame_bytes: 1241 * 376 * 3,
    color_channels: 3,
    mapping: MappingPlan { resolution: 0.5, window: 6, learned_decoder: true, trains_depth: false },
    compute: ComputeMemory::Cpu,
    has_networks: false,
    has_loops: true,
};

const FULL_HD: PlanInput = PlanInput { width: 1920, height: 1080, frame_bytes: 1920 * 1080 * 3, ..COLOR_KITTI };

const TINY_CAMERA: PlanInput =
    PlanInput { width: 128, height: 96, frame_bytes: 128 * 96, color_channels: 1, ..COLOR_KITTI };

fn profile(name: &str) -> Budget {
    let (_, text) = PROFILES.iter().find(|(known, _)| *known == name).expect("a built-in profile");
    Budget::parse(text, name).unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn every_built_in_profile_fits_the_camera_it_is_made_for() {
    let check = |name: &str, input: &PlanInput, cap: u64| {
        let budget = profile(name);
        assert_eq!(budget.host_bytes(), cap, "{name}");
        let plan = Plan::compute(&budget, input);
        assert!(plan.check().is_ok(), "{name}: {}\n{plan}", plan.check().unwrap_err());
    };
    check("memory_budget.toml", &COLOR_KITTI, 512 << 20);
    check("1080p-2gib.toml", &FULL_HD, 2 << 30);
    check("tiny.toml", &TINY_CAMERA, 96 << 20);
}

#[test]
fn a_larger_camera_does_not_fit_the_small_profile_and_the_message_says_which_row() {
    let plan = Plan::compute(
        &profile("memory_budget.toml"),
        &PlanInput { width: 7680, height: 4320, frame_bytes: 99_532_800, ..COLOR_KITTI },
    );
    let message = plan.check().unwrap_err().to_string();
    for part in ["memory_budget.toml", "host memory", "512 MiB", "takes", "raise host_bytes"] {
        assert!(message.contains(part), "{part:?} is not in {message:?}");
    }
}

/// The shipped default with one piece of text replaced.
fn edited(from: &str, to: &str) -> Result<Budget, BudgetError> {
    let text = PROFILES[0].1;
    assert_eq!(text.matches(from).count(), 1, "{from:?} must stand exactly once in the default");
    Budget::parse(&text.replace(from, to), "my.toml")
}

/// The default with the first line that starts with `key` in the table `row` replaced by `line`.
fn with_line(row: &str, key: &str, line: &str) -> Result<Budget, BudgetError> {
    let mut in_row = false;
    let mut replaced = 0;
    let lines: Vec<_> = PROFILES[0]
        .1
        .lines()
        .map(|old| {
            if old.starts_with('[') {
                in_row = old == row;
            }
            if in_row && old.split('=').next().map(str::trim) == Some(key) {
                replaced += 1;
                return line;
            }
            old
        })
        .collect();
    assert_eq!(replaced, 1, "{row} {key}");
    Budget::parse(&lines.join("\n"), "my.toml")
}

#[test]
fn what_cannot_be_meant_is_refused_with_file_row_and_fix() {
    let check = |result: Result<Budget, BudgetError>, parts: &[&str]| {
        let message = result.expect_err(parts[0]).to_string();
        assert!(message.starts_with("my.toml"), "{message}");
        for part in parts {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    };
    let anchors = |line| with_line("[map.anchors]", "capacity", line);
    check(anchors("capacity = 0"), &["[map.anchors]", "zero", "choose 64"]);
    check(anchors("capacity = -5"), &["[map.anchors]", "-5", "negative", "whole number"]);
    check(anchors("capacity = 999999999999"), &["[map.anchors]", "out of range"]);
    check(anchors("capacity = 99999999999999999999999999"), &["[map.anchors]", "too large"]);
    check(anchors("capacity = \"many\""), &["[map.anchors]", "capacity is a string"]);
    check(anchors("capacity = 1.5"), &["[map.anchors]", "capacity is a float"]);
    check(
        anchors("capacity = 4096\nsize = 3"),
        &["[map.anchors]", "unknown key \"size\"", "capacity, where, when_full, why"],
    );
    check(anchors(""), &["[map.anchors] capacity", "missing", "add a line"]);
    check(with_line("[map.anchors]", "where", "where = \"ipc\""), &["[map.anchors]", "ipc", "write both or device"]);
    check(with_line("[map.anchors]", "where", "where = \"moon\""), &["[map.anchors]", "moon", "write both or device"]);
    check(
        with_line("[map.anchors]", "when_full", "when_full = \"evict-worst\""),
        &["[map.anchors]", "not what this container can do", "\"refuse\""],
    );
    check(with_line("[map.anchors]", "when_full", "when_full = \"grow\""), &["[map.anchors]", "no policy"]);
    check(with_line("[map.anchors]", "why", "why = \"\""), &["[map.anchors]", "why is empty"]);
    check(with_line("[total]", "host_bytes", "host_bytes = 0"), &["[total]", "host_bytes is zero"]);
    check(with_line("[total]", "host_bytes", "host_bytes = \"12 MB\""), &["[total]", "not a size"]);
    check(
        with_line("[total]", "host_bytes", "hostbytes = 5"),
        &["[total]", "unknown key \"hostbytes\"", "host_bytes, device_bytes"],
    );
    check(
        with_line("[process.camera_child]", "capacity", "capacity = \"1 B\""),
        &["[process.camera_child]", "out of range"],
    );
    check(edited("[map.anchors]", "[map.anchor]"), &["[map]", "unknown key \"anchor\"", "anchors"]);
    check(edited("[map.anchors]", "[maps.anchors]"), &["[maps]", "unknown section", "tracking"]);
    check(edited("[total]", "[totals]"), &["[totals]", "unknown section"]);
    check(edited("[total]", "[total"), &["not valid TOML"]);
    check(
        with_line("[ipc.frame_slots]", "capacity", "capacity = 10"),
        &["[ipc.frame_slots]", "evenly", "odd number such as 11"],
    );
    check(
        with_line("[map.voxels]", "capacity", "capacity = 70000"),
        &["[map.voxels]", "too small for [map.anchors]", "three quarters"],
    );
    check(
        with_line("[map.new_anchors]", "capacity", "capacity = 200000"),
        &["[map.anchors]", "too small for [map.new_anchors]"],
    );
    check(
        with_line("[splat.pairs]", "capacity", "capacity = 1000"),
        &["[splat.pairs]", "too small for [splat.visible_gaussians]"],
    );
    check(
        with_line("[tracking.pyramids]", "capacity", "capacity = 4"),
        &["[tracking.pyramids]", "out of range", "choose 3"],
    );
    check(Budget::parse("[total]\nhost_bytes = 1\ndevice_bytes = 1\n", "my.toml"), &["[ipc.frame_slots]", "missing"]);
    check(Budget::parse("map = 3\n", "my.toml"), &["[map]", "not a table"]);
}

#[test]
fn an_error_names_the_line() {
    let line = PROFILES[0].1.lines().position(|line| line == "[map.anchors]").expect("the row") + 2;
    let message = with_line("[map.anchors]", "capacity", "capacity = 0").unwrap_err().to_string();
    assert!(message.starts_with(&format!("my.toml:{line}: ")), "{message}");
}

#[test]
fn lowering_the_named_row_to_the_named_capacity_makes_the_plan_fit() {
    let plan_of = |budget: &Budget| Plan::compute(budget, &COLOR_KITTI);
    let too_large = with_line("[splat.pairs]", "capacity", "capacity = 60000000").expect("in range");
    let message = plan_of(&too_large).check().unwrap_err().to_string();
    assert!(message.contains("[splat.pairs] takes"), "{message}");
    let capacity: u64 = message
        .split("at most ")
        .nth(1)
        .and_then(|rest| rest.split(',').next())
        .and_then(|number| number.parse().ok())
        .unwrap_or_else(|| panic!("no capacity in {message}"));
    let line = |capacity: u64| format!("capacity = {capacity}");
    let with = |capacity| with_line("[splat.pairs]", "capacity", &line(capacity)).expect("in range");
    assert!(plan_of(&with(capacity)).check().is_ok(), "{message}");
    assert!(plan_of(&with(capacity + 2)).check().is_err(), "{message}");
}

#[test]
fn a_device_with_its_own_memory_has_its_own_cap() {
    let budget = profile("memory_budget.toml");
    let on_host = Plan::compute(&budget, &COLOR_KITTI);
    let on_device = Plan::compute(&budget, &PlanInput { compute: ComputeMemory::OwnDevice, ..COLOR_KITTI });
    assert_eq!(on_host.device_bytes(), 0);
    assert!(on_device.device_bytes() > 0, "its arena");
    let added = on_device.host_bytes() - on_host.host_bytes();
    let driver = budget.capacity(Row::ProcessComputeDriver) as u64;
    assert!(
        (driver..driver + (64 << 20)).contains(&added),
        "{added}: the driver, and what the host remembers of the map"
    );
    let shared = Plan::compute(&budget, &PlanInput { compute: ComputeMemory::SharedDevice, ..COLOR_KITTI });
    assert_eq!(shared.device_bytes(), 0);
    assert!(
        shared.host_bytes() >= driver + shared.arena_bytes() && shared.arena_bytes() > 0,
        "its arena is on the host"
    );
    let small = with_line("[total]", "device_bytes", "device_bytes = \"1 MiB\"").expect("valid");
    let message =
        Plan::compute(&small, &PlanInput { compute: ComputeMemory::OwnDevice, ..COLOR_KITTI }).check().unwrap_err();
    assert!(message.to_string().contains("device memory"), "{message}");
}

#[test]
fn the_arena_of_the_tiny_profile_opens_within_its_cap() {
    let Some(device) = testing::device() else { return };
    let budget = profile("tiny.toml");
    let input = PlanInput { compute: ComputeMemory::OwnDevice, ..TINY_CAMERA };
    let plan = Plan::compute(&budget, &input);
    assert!(plan.device_bytes() <= budget.device_bytes(), "{plan}");
    let opened = VulkanExecutor::new(&device, &budget.splat_capacities(&input), plan.arena_bytes());
    let taken = opened.unwrap_or_else(|e| panic!("{e}")).device_bytes() as u64;
    assert!((1 << 20..=plan.device_bytes()).contains(&taken), "{taken} B of {} B planned", plan.device_bytes());
}

#[test]
fn the_plan_adds_up_and_shows_every_row() {
    let plan = Plan::compute(&profile("memory_budget.toml"), &COLOR_KITTI);
    let by_hand: u64 = plan.rows().iter().map(|row| row.bytes_each * row.capacity).sum();
    assert_eq!(plan.host_bytes(), by_hand + plan.ipc_bytes(), "shared frames are seen by two processes");
    let shown = plan.to_string();
    for spec in &ROWS {
        assert!(shown.contains(&spec.row.to_string()), "{} is not in\n{shown}", spec.row);
    }
}

#[test]
fn a_file_beats_a_profile_of_the_same_name_and_a_missing_file_is_explained() {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let path = dir.path().join("tiny.toml");
    std::fs::write(&path, "[total]\n").expect("a file");
    assert!(Budget::load(Some(&path)).is_err());
    assert!(Budget::load(Some(Path::new("tiny.toml"))).is_ok());
    let message = Budget::load(Some(&dir.path().join("none.toml"))).unwrap_err().to_string();
    assert!(message.contains("none.toml") && message.contains("--budget"), "{message}");
}

#[test]
fn one_row_too_large_for_a_device_is_named() {
    let check = |compute: ComputeMemory, row: &str, capacity: u64, domain: &str| {
        let large = with_line(&format!("[{row}]"), "capacity", &format!("capacity = {capacity}")).expect("in range");
        let message = Plan::compute(&large, &PlanInput { compute, ..COLOR_KITTI }).check().unwrap_err().to_string();
        for part in [domain, &format!("[{row}] takes"), "set its capacity to at most"] {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    };
    let (own, shared) = (ComputeMemory::OwnDevice, ComputeMemory::SharedDevice);
    check(shared, "splat.pairs", 60_000_000, "host memory");
    check(shared, "splat.row_entries", 12_000_000, "host memory");
    check(own, "splat.pairs", 60_000_000, "memory");
}

#[test]
fn a_window_that_the_rows_do_not_hold_is_refused_by_name() {
    let check = |row: &str, capacity: u64, window: usize, expected: &[&str]| {
        let budget = with_line(&format!("[{row}]"), "capacity", &format!("capacity = {capacity}")).expect("in range");
        let mapping = MappingPlan { window, ..COLOR_KITTI.mapping };
        let verdict = Plan::compute(&budget, &PlanInput { mapping, ..COLOR_KITTI }).check();
        let message = verdict.err().map(|error| error.to_string()).unwrap_or_default();
        assert_eq!(message.is_empty(), expected.is_empty(), "{message}");
        for part in expected {
            assert!(message.contains(part), "{part:?} is not in {message:?}");
        }
    };
    check("map.keyframe_images", 7, 6, &[]);
    check("map.keyframe_images", 6, 6, &["my.toml", "[map.keyframe_images]", "mapping.window = 6", "at least 7"]);
    check("map.keyframes", 16, 6, &[]);
    check("map.keyframes", 15, 6, &["[map.keyframes]", "mapping.window = 6", "at least 16"]);
    check("map.keyframes", 512, 48, &["[map.keyframe_images]", "mapping.window = 48", "at least 49"]);
}

#[test]
fn trained_networks_fit_the_default_and_cost_nothing_when_none_runs() {
    let budget = profile("memory_budget.toml");
    let [without, with] =
        [false, true].map(|has_networks| Plan::compute(&budget, &PlanInput { has_networks, ..COLOR_KITTI }));
    assert!(with.check().is_ok(), "{with}");
    assert_eq!(with.host_bytes() - without.host_bytes(), budget.capacity(Row::InferenceArena) as u64);
}

#[test]
fn the_default_holds_a_software_device() {
    let plan = Plan::compute(
        &profile("memory_budget.toml"),
        &PlanInput { compute: ComputeMemory::SharedDevice, ..COLOR_KITTI },
    );
    assert!(plan.check().is_ok(), "{plan}");
}

#[test]
fn closing_loops_costs_nothing_when_it_is_off() {
    let budget = profile("memory_budget.toml");
    let [without, with] =
        [false, true].map(|has_loops| Plan::compute(&budget, &PlanInput { has_loops, ..COLOR_KITTI }));
    let of_loops = |plan: &Plan| {
        let is_theirs = |row: Row| row.spec().section == "loops" || row == Row::PipelineLoopQueue;
        plan.rows().iter().filter(|planned| is_theirs(planned.row)).map(|planned| planned.bytes).sum::<u64>()
    };
    assert_eq!((of_loops(&without), of_loops(&with)), (0, with.host_bytes() - without.host_bytes()));
    assert!(of_loops(&with) < 16 << 20, "{with}");
}
