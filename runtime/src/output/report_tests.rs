use super::*;
use serde_json::Value;
use std::collections::BTreeSet;

/// The block of contracts.md, kept here so that the test needs nothing beside the repository.
const CONTRACT: &str = r#"{ "version": 1, "command": "...",
  "frames": {"received":0,"tracked":0,"keyframes":0,"doubtful":0,"lost":0,"dropped":0,"refused":0},
  "time": {"wall_s":0,"per_frame_ms":{"p50":0,"p95":0,"max":0},"tracking_ms":{"p50":0,"p95":0,"max":0},"mapping_iterations":0,"mapping_it_per_s":0},
  "memory": {"rss_peak_bytes":0,"camera_rss_peak_bytes":0,"device_peak_bytes":0,"ipc_bytes":0,"budget_host_bytes":0,"budget_device_bytes":0,
             "plan":[{"row":"map.anchors","bytes":0,"used_peak":0,"where":"host","when_full":"..."}],"sealed_allocations":0,"refusals":0,"rss_slope_bytes_per_km":null},
  "tracking": {"essential":0,"pnp":0,"dense_fallback":0,"anomalies":0,"scale_source":"ground_plane","loops":0,"path_length_m":0},
  "mapping": {"anchors_resident":0,"anchors_total":0,"anchors_refused":0,"gaussians":0,"chunks":0,"pages_written":0,"pages_returned":0,"map_bytes":0,"store_bytes":0,
              "psnr_train_db":null,"ssim_train":null,"psnr_heldout_db":null,"ssim_heldout":null,"psnr_worst_100m_db":null},
  "backend": {"kind":"cpu","device":"...","simd":"avx512","threads":2} }"#;

/// Every path through objects, and through the first element of lists, as `a.b.c`.
fn key_paths(value: &Value) -> BTreeSet<String> {
    fn walk(value: &Value, prefix: &str, paths: &mut BTreeSet<String>) {
        match value {
            Value::Object(members) => members.iter().for_each(|(key, member)| {
                let path = format!("{prefix}.{key}");
                walk(member, &path, paths);
                paths.insert(path);
            }),
            Value::Array(elements) => elements.iter().take(1).for_each(|element| walk(element, prefix, paths)),
            _ => {}
        }
    }
    let mut paths = BTreeSet::new();
    walk(value, "", &mut paths);
    paths
}

fn with_one_row() -> Report {
    let memory = Memory { plan: vec![MemoryRow::default()], ..Memory::default() };
    Report { memory, ..Report::default() }
}

#[test]
fn the_keys_are_those_of_the_contract() {
    let contract: Value = serde_json::from_str(CONTRACT).expect("the contract is JSON");
    let written = serde_json::to_value(with_one_row()).expect("a report");
    assert_eq!(key_paths(&written), key_paths(&contract));
    assert!(key_paths(&contract).len() > 50);
    let read: Result<Report, _> = serde_json::from_value(contract.clone());
    assert!(read.is_ok(), "types of the contract: {read:?}");
}

#[test]
fn the_copy_of_the_contract_is_the_contract() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/design/contracts.md");
    let Ok(text) = std::fs::read_to_string(path) else {
        println!("left out: {path} is not there");
        return;
    };
    assert!(text.contains(CONTRACT), "contracts.md has changed: update CONTRACT and the report");
}

#[test]
fn what_is_unknown_is_null_and_a_report_survives_its_file() {
    let dir = tempfile::tempdir().expect("temporary folder");
    let mut report = with_one_row();
    report.time.mapping_it_per_s = Some(f64::INFINITY);
    report.mapping.psnr_train_db = Some(17.25);
    report.write(dir.path()).expect("written");
    let text = std::fs::read_to_string(dir.path().join("report.json")).expect("report.json");
    let read: Report = serde_json::from_str(&text).expect("a report");
    assert_eq!(read.mapping.psnr_train_db, Some(17.25));
    assert_eq!(read.time.mapping_it_per_s, None, "JSON has no infinity");
    assert!(text.contains(r#""camera_rss_peak_bytes": null"#), "{text}");
}

#[test]
fn the_plan_of_the_shipped_budget_is_listed_with_its_peaks() {
    use crate::budget::{Budget, Plan, PlanInput, Row, Usage};
    let budget = Budget::builtin().expect("the shipped budget");
    let input = PlanInput {
        width: 1241,
        height: 376,
        frame_bytes: 1241 * 376,
        color_channels: 1,
        mapping: crate::budget::MappingPlan { resolution: 0.5, window: 6, learned_decoder: false, trains_depth: true },
        compute: crate::budget::ComputeMemory::Cpu,
        has_networks: false,
        has_loops: false,
    };
    let plan = Plan::compute(&budget, &input);
    let usage = Usage::default();
    usage.observe(Row::MapAnchors, 10);
    usage.refuse(Row::MapAnchors, 3);
    let memory = Memory::planned(&plan, &usage, budget.host_bytes(), budget.device_bytes());
    assert_eq!(memory.plan.len(), plan.rows().len());
    let anchors = memory.plan.iter().find(|row| row.row == "map.anchors").expect("a row");
    let each = anchors.bytes / budget.capacity(Row::MapAnchors) as u64;
    assert_eq!((anchors.used_peak, memory.refusals), (Some(10 * each), 3));
    let voxels = memory.plan.iter().find(|row| row.row == "map.voxels").expect("a row");
    assert_eq!(voxels.used_peak, None, "nobody looked");
    // Counted in another row.
    usage.observe(Row::StorePageAnchors, 5);
    let memory = Memory::planned(&plan, &usage, budget.host_bytes(), budget.device_bytes());
    let page_anchors = memory.plan.iter().find(|row| row.row == "store.page_anchors").expect("a row");
    assert_eq!((page_anchors.bytes, page_anchors.used_peak), (0, None));
}
