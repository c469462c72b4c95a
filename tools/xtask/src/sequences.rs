//! `cargo xtask sequences`: replays recordings with the release binary and prints what came out.

use crate::step::{StepFailed, run as step};
use serde_json::Value;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Recordings in the order of the table: folder, and the most frames that a run of minutes can take.
const RECORDINGS: [(&str, u32); 4] = [
    ("kitti04-full", 271),
    ("kitti00-0000-1699", 400),
    ("kitti00-lowres-colour-0000-1017", 1018),
    ("kittiraw-0926-0060-lidar-colour", 78),
];

/// Options of `cargo xtask sequences`.
#[derive(Debug, clap::Args)]
pub(crate) struct SequencesArgs {
    /// Only recordings whose name contains this.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// At most this many frames of each.
    #[arg(long, value_name = "N")]
    frames: Option<u32>,
    /// Folder of the recordings; the default is $KILOGS_DATA, then ../shared/data.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Options handed on to `kilogs replay`, after `--`.
    #[arg(last = true)]
    replay: Vec<String>,
}

/// Columns of the table: heading, file, path of keys, factor, digits.
const COLUMNS: [(&str, &str, &[&str], f64, usize); 12] = [
    ("received", "report.json", &["frames", "received"], 1.0, 0),
    ("tracked", "report.json", &["frames", "tracked"], 1.0, 0),
    ("doubtful", "report.json", &["frames", "doubtful"], 1.0, 0),
    ("lost", "report.json", &["frames", "lost"], 1.0, 0),
    ("ATE Sim(3) m", "eval.json", &["ate_sim3_m"], 1.0, 3),
    ("ATE SE(3) m", "eval.json", &["ate_se3_m"], 1.0, 3),
    ("scale", "eval.json", &["scale"], 1.0, 4),
    ("PSNR train dB", "eval.json", &["psnr_train_db"], 1.0, 2),
    ("PSNR held out dB", "eval.json", &["psnr_heldout_db"], 1.0, 2),
    ("peak RSS MiB", "report.json", &["memory", "rss_peak_bytes"], 1.0 / 1_048_576.0, 1),
    ("sealed allocations", "report.json", &["memory", "sealed_allocations"], 1.0, 0),
    ("wall s", "report.json", &["time", "wall_s"], 1.0, 1),
];

/// Replays, evaluates and prints a Markdown table on stdout. Output folders go below `target/`.
pub(crate) fn run(root: &Path, args: &SequencesArgs) -> Result<(), StepFailed> {
    let data = args
        .data
        .clone()
        .or_else(|| std::env::var_os("KILOGS_DATA").map(PathBuf::from))
        .unwrap_or_else(|| root.join("../shared/data"));
    let wanted = |name: &str| args.only.as_deref().is_none_or(|text| name.contains(text));
    let recordings: Vec<_> = RECORDINGS.into_iter().filter(|(name, _)| wanted(name)).collect();
    if !recordings.iter().any(|(name, _)| data.join(name).is_dir()) {
        let reason = format!("no recording in {}; give their folder with --data DIR or KILOGS_DATA", data.display());
        return Err(StepFailed::Broken(reason));
    }
    step(root, "release binary", "cargo", &["build", "--release", "--bin", "kilogs"], &[])?;
    let mut table = heading();
    for (name, most_frames) in recordings {
        let dataset = data.join(name);
        if !dataset.is_dir() {
            eprintln!("left out: {} is not there", dataset.display());
            continue;
        }
        let frames = args.frames.unwrap_or(most_frames).min(most_frames);
        let out = root.join("target/sequences").join(name);
        replay_and_judge(root, &dataset, &out, frames, &args.replay)?;
        let _ = writeln!(table, "{}", row(name, &out)?);
    }
    println!("{table}");
    Ok(())
}

fn replay_and_judge(root: &Path, dataset: &Path, out: &Path, frames: u32, more: &[String]) -> Result<(), StepFailed> {
    let (dataset_text, out_text, frames) = (dataset.to_string_lossy(), out.to_string_lossy(), frames.to_string());
    let mut arguments = vec!["replay", &*dataset_text, "--camera", "kitti", "--out", &*out_text, "--frames", &frames];
    arguments.extend(more.iter().map(String::as_str));
    step(root, "replay", "target/release/kilogs", &arguments, &[])?;
    let truth = dataset.join("poses.txt");
    if !truth.is_file() {
        return Ok(());
    }
    let arguments = ["eval", &*out_text, "--gt", &*truth.to_string_lossy(), "--dataset", &*dataset_text];
    step(root, "evaluation", "target/release/kilogs", &arguments, &[])
}

fn heading() -> String {
    let names: Vec<_> = COLUMNS.iter().map(|(name, ..)| *name).collect();
    format!("| recording | {} |\n|---|{}\n", names.join(" | "), "---:|".repeat(COLUMNS.len()))
}

/// One line of the table; a figure that could not be measured is a dash.
fn row(name: &str, out: &Path) -> Result<String, StepFailed> {
    let report = read_json(&out.join("report.json"))?;
    let eval = read_json(&out.join("eval.json")).unwrap_or(Value::Null);
    let cells = COLUMNS.iter().map(|(_, file, keys, factor, digits)| {
        let document = if *file == "report.json" { &report } else { &eval };
        let value = keys.iter().try_fold(document, |value, key| value.get(key)).and_then(Value::as_f64);
        value.map_or_else(|| "-".to_owned(), |number| format!("{:.digits$}", number * factor))
    });
    Ok(format!("| {name} | {} |", cells.collect::<Vec<_>>().join(" | ")))
}

fn read_json(path: &Path) -> Result<Value, StepFailed> {
    let broken = |reason: String| StepFailed::Broken(format!("reading {}: {reason}", path.display()));
    let text = std::fs::read_to_string(path).map_err(|error| broken(error.to_string()))?;
    serde_json::from_str(&text).map_err(|error| broken(error.to_string()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_shows_figures_and_dashes() {
        let dir = tempfile::tempdir().expect("a temporary folder");
        let report = r#"{"frames":{"received":271,"tracked":270},"memory":{"rss_peak_bytes":314572800},"time":{"wall_s":12.34}}"#;
        std::fs::write(dir.path().join("report.json"), report).expect("a file");
        let without_truth = row("street", dir.path()).expect("a report");
        assert_eq!(without_truth, "| street | 271 | 270 | - | - | - | - | - | - | - | 300.0 | - | 12.3 |");
        std::fs::write(dir.path().join("eval.json"), r#"{"ate_sim3_m":0.12345,"scale":1.01,"psnr_train_db":null}"#)
            .expect("a file");
        let judged = row("street", dir.path()).expect("a report");
        assert_eq!(judged, "| street | 271 | 270 | - | - | 0.123 | - | 1.0100 | - | - | 300.0 | - | 12.3 |");
        assert!(row("street", &dir.path().join("none")).is_err());
        assert_eq!(heading().matches('|').count(), 2 * (COLUMNS.len() + 2));
    }
}
