//! `kilogs eval` on small output folders: which pose meets which truth, and what stands in `eval.json`.

use kilogs_eval::command::{EvalArgs, EvalError, LpipsFigures, judge, run};
use std::path::Path;
use tempfile::TempDir;

const STEP_M: f64 = 2.0;

/// A straight drive of `n` images at 10 Hz: the data set, with truth and times.
fn dataset(folder: &Path, n: usize, with_times: bool) {
    let pose = |k: usize| format!("1 0 0 {} 0 1 0 0 0 0 1 {}\n", (k as f64 * 0.1).sin(), k as f64 * STEP_M);
    write(folder, "poses.txt", (0..n).map(pose).collect());
    if with_times {
        write(folder, "times.txt", (0..n).map(|k| format!("{:.6e}\n", k as f64 * 0.1)).collect());
    }
}

/// A run over images `start..start + n` whose lengths are `scale` times the true ones.
fn run_folder(folder: &Path, start: usize, n: usize, scale: f64) {
    let tum = |k: usize| {
        let image = start + k;
        let (x, z) = (scale * (image as f64 * 0.1).sin(), scale * image as f64 * STEP_M);
        format!("{:.9} {x:.9} 0 {z:.9} 0 0 0 1\n", image as f64 * 0.1)
    };
    write(folder, "trajectory_tum.txt", (0..n).map(tum).collect());
    let rows = (0..n).map(|k| format!("{k},{:.9},tracked\n", (start + k) as f64 * 0.1));
    write(folder, "frames.csv", std::iter::once("index,t,status\n".to_owned()).chain(rows).collect());
}

fn write(folder: &Path, name: &str, text: String) {
    std::fs::write(folder.join(name), text).expect("temporary file");
}

struct Places {
    run: TempDir,
    data: TempDir,
}

fn places() -> Places {
    let folder = || tempfile::tempdir().expect("temporary folder");
    Places { run: folder(), data: folder() }
}

#[test]
fn a_run_that_starts_late_is_matched_by_the_times_of_the_data_set() {
    for (dataset_given, scale) in [(false, 1.0), (true, 1.25)] {
        let Places { run, data } = places();
        dataset(data.path(), 120, true);
        run_folder(run.path(), 30, 80, scale);
        let gt = data.path().join("poses.txt");
        let judgement = judge(run.path(), &gt, dataset_given.then_some(data.path())).expect("judged");
        assert_eq!((judgement.n_judged, judgement.n_estimated), (80, 80));
        assert!(judgement.file.ate_sim3_m.is_some_and(|m| m < 1e-6), "{judgement:?}");
        assert!(judgement.file.scale.is_some_and(|s| (s - 1.0 / scale).abs() < 1e-6), "{judgement:?}");
        let drift_percent = 100.0 * (scale - 1.0);
        assert!(
            judgement.file.segment_translation_percent.is_some_and(|p| (p - drift_percent).abs() < 1.0),
            "{judgement:?}"
        );
    }
}

#[test]
fn without_times_the_index_in_frames_csv_says_which_image_it_was() {
    let Places { run, data } = places();
    dataset(data.path(), 60, false);
    run_folder(run.path(), 0, 40, 1.0);
    let judgement = judge(run.path(), &data.path().join("poses.txt"), None).expect("judged");
    assert_eq!(judgement.n_judged, 40);
    assert!(judgement.file.ate_se3_m.is_some_and(|m| m < 1e-6), "{judgement:?}");
    assert_eq!(judgement.file.segment_translation_percent, None, "78 m are too short for a segment");
    let named = judge(run.path(), &data.path().join("poses.txt"), Some(data.path()));
    assert!(matches!(named, Err(EvalError::Unreadable { .. })), "a named data set must have times: {named:?}");
}

#[test]
fn eval_json_has_exactly_the_keys_of_the_contract() {
    const KEYS: &str = "ate_sim3_m, ate_se3_m, scale, segment_translation_percent, segment_rotation_deg_per_100m, \
         rpe_rotation_deg, rpe_translation_m, psnr_train_db, psnr_heldout_db, ssim_train, ssim_heldout, lpips_train, \
         lpips_heldout";
    let Places { run: folder, data } = places();
    dataset(data.path(), 20, true);
    run_folder(folder.path(), 0, 20, 1.0);
    let report = r#"{"mapping": {"psnr_train_db": 17.5, "ssim_train": 0.5, "psnr_heldout_db": null}}"#;
    write(folder.path(), "report.json", report.to_owned());
    let args = EvalArgs { dir: folder.path().to_owned(), gt: data.path().join("poses.txt"), dataset: None };
    run(&args, || LpipsFigures { train: Some(0.25), held_out: None }).expect("judged");
    let text = std::fs::read_to_string(folder.path().join("eval.json")).expect("eval.json");
    let written: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).expect("JSON");
    let mut keys: Vec<&str> = KEYS.split(", ").collect();
    let mut found: Vec<&str> = written.keys().map(String::as_str).collect();
    keys.sort_unstable();
    found.sort_unstable();
    assert_eq!(found, keys);
    assert_eq!((written["psnr_train_db"].as_f64(), written["lpips_train"].as_f64()), (Some(17.5), Some(0.25)));
    for unknown in ["psnr_heldout_db", "ssim_heldout", "lpips_heldout", "segment_translation_percent"] {
        assert!(written[unknown].is_null(), "{unknown} is {}", written[unknown]);
    }
}

#[test]
fn what_cannot_be_judged_is_refused_with_the_reason() {
    let Places { run, data } = places();
    let gt = data.path().join("poses.txt");
    let complaint = || judge(run.path(), &gt, None).expect_err("cannot be judged").to_string();
    assert!(complaint().contains("did the run finish?"), "{}", complaint());
    run_folder(run.path(), 500, 10, 1.0);
    dataset(data.path(), 20, true);
    assert!(complaint().contains("none of 10 poses belongs to any of 20"), "{}", complaint());
    write(data.path(), "times.txt", "0.0\n0.1\n".to_owned());
    assert!(complaint().contains("it has 20 poses, but") && complaint().contains("has 2 times"), "{}", complaint());
    write(data.path(), "poses.txt", "1 2 3\n".to_owned());
    assert!(complaint().contains("line 1 has 3 numbers, 12 are needed"), "{}", complaint());
    run_folder(run.path(), 0, 10, 1.0);
    dataset(data.path(), 20, true);
    write(run.path(), "report.json", "{".to_owned());
    assert!(complaint().contains("is not JSON"), "{}", complaint());
}
