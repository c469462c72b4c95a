//! `cargo xtask sequences overview`: a line per recording, tracked and mapped.

use super::{CommonArgs, read_json};
use crate::step::StepFailed;
use serde_json::Value;
use std::fmt::Write as _;
use std::path::Path;

/// Recordings in the order of the table: folder, and the most frames that a run of minutes can take.
const RECORDINGS: [(&str, u32); 4] = [
    ("kitti04-full", 271),
    ("kitti00-0000-1699", 400),
    ("kitti00-lowres-colour-0000-1017", 1018),
    ("kittiraw-0926-0060-lidar-colour", 78),
];

/// Options of `cargo xtask sequences overview`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cargo xtask sequences overview --only kitti04 --frames 100")]
pub(super) struct OverviewArgs {
    /// What all tables share.
    #[command(flatten)]
    common: CommonArgs,
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
pub(super) fn run(root: &Path, args: &OverviewArgs) -> Result<(), StepFailed> {
    let bench = args.common.bench(root, RECORDINGS.map(|(name, _)| name))?;
    let mut table = heading();
    for name in &bench.recordings {
        let most_frames = RECORDINGS.iter().find(|(known, _)| known == name).map_or(0, |(_, most_frames)| *most_frames);
        let (dataset, out) = (bench.data.join(name), bench.out.join("overview").join(name));
        let frames = args.common.frames.unwrap_or(most_frames).min(most_frames);
        let mut options = vec!["--camera".to_owned(), "kitti".to_owned(), format!("--frames={frames}")];
        options.extend(args.replay.iter().cloned());
        bench.replay_and_judge(&dataset, &out, &options)?;
        let _ = writeln!(table, "{}", row(name, &out)?);
    }
    println!("{table}");
    Ok(())
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
