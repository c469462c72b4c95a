//! The figures of a drive with and without closing loops, out of both output folders.

use super::judge::{Judgement, LoopLog, TruePose, in_revisited_streets};
use crate::sequences::read_json;
use crate::sequences::table::Table;
use crate::step::StepFailed;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Both documents of an output folder.
struct Folder {
    report: Value,
    eval: Value,
}

impl Folder {
    fn read(out: &Path) -> Result<Self, StepFailed> {
        Ok(Self { report: read_json(&out.join("report.json"))?, eval: read_json(&out.join("eval.json"))? })
    }

    fn ate_sim3(&self) -> String {
        number(&self.eval, &["ate_sim3_m"], 1.0, 2)
    }
}

/// A figure; one that could not be measured is a dash.
fn number(document: &Value, keys: &[&str], factor: f64, digits: usize) -> String {
    let value = keys.iter().try_fold(document, |value, key| value.get(key)).and_then(Value::as_f64);
    value.map_or_else(|| "-".to_owned(), |number| format!("{:.digits$}", number * factor))
}

const MIB: f64 = 1.0 / 1_048_576.0;

/// A drive, without and with.
pub(super) struct Drive {
    folders: [Folder; 2],
    log: LoopLog,
    judgement: Judgement,
    /// Mean PSNR of the views in revisited streets that both maps have, dB.
    psnr_db: Option<[f64; 2]>,
}

impl Drive {
    /// Headings of [`cells`](Self::cells).
    pub const HEADINGS: [&'static str; 10] = [
        "frames, keyframes",
        "loops right / wrong",
        "revisits found",
        "streets found",
        "ATE Sim(3) without / with, m",
        "SE(3), m",
        "peak RSS, MiB",
        "growth, MiB/km",
        "PSNR driven again, dB",
        "refused",
    ];

    /// Reads the output folders without and with, and the truth.
    pub fn read([without, with]: [&Path; 2], truth: &Path) -> Result<Self, StepFailed> {
        let (log, truth) = (LoopLog::read(with)?, TruePose::read(truth)?);
        let judgement = Judgement::of(&log, &truth);
        let psnr_db = match [without, with].map(|out| out.join("views.csv")) {
            [a, b] if a.is_file() && b.is_file() => psnr_driven_again([&a, &b], &log, &truth)?,
            _ => None,
        };
        Ok(Self { folders: [Folder::read(without)?, Folder::read(with)?], log, judgement, psnr_db })
    }

    /// A cell for each heading.
    pub fn cells(&self) -> Vec<String> {
        let [without, with] = &self.folders;
        let eval = |key: &str| [without, with].map(|f| number(&f.eval, &[key], 1.0, 2)).join(" / ");
        let memory = |key: &str, digits| number(&with.report, &["memory", key], MIB, digits);
        let Judgement { n_wrong, n_revisits, n_found, n_streets, n_streets_found } = self.judgement;
        let n_frames = number(&with.report, &["frames", "received"], 1.0, 0);
        vec![
            format!("{n_frames}, {}", self.log.keyframes.len()),
            format!("{} / {n_wrong}", self.log.closed.len() - n_wrong),
            format!("{n_found} of {n_revisits}"),
            format!("{n_streets_found} of {n_streets}"),
            eval("ate_sim3_m"),
            eval("ate_se3_m"),
            memory("rss_peak_bytes", 0),
            memory("rss_slope_bytes_per_km", 2),
            self.psnr_db.map_or_else(|| "-".to_owned(), |db| db.map(|db| format!("{db:.2}")).join(" / ")),
            self.log.refused(),
        ]
    }
}

/// Mean PSNR of both maps, over the views in revisited streets that both have.
fn psnr_driven_again(tables: [&Path; 2], log: &LoopLog, truth: &[TruePose]) -> Result<Option<[f64; 2]>, StepFailed> {
    let [without, with] = tables.map(psnr_of_views);
    let (without, with) = (without?, with?);
    let both: BTreeSet<usize> = without.keys().filter(|frame| with.contains_key(frame)).copied().collect();
    let again = in_revisited_streets(&both, &log.keyframes, truth);
    let mean = |db: &BTreeMap<usize, f64>| again.iter().map(|frame| db[frame]).sum::<f64>() / again.len() as f64;
    Ok((!again.is_empty()).then(|| [mean(&without), mean(&with)]))
}

fn psnr_of_views(path: &Path) -> Result<BTreeMap<usize, f64>, StepFailed> {
    let table = Table::read(path)?;
    let rows = table.rows(["frame", "psnr_db"])?;
    rows.map(|[frame, psnr_db]| Ok((table.number(frame)?, table.number(psnr_db)?))).collect()
}

/// A drive with missing frames, without and with.
pub(super) struct Cut {
    folders: [Folder; 2],
    largest_m: [String; 2],
    n_wrong: usize,
    n_until_tracked: Option<usize>,
    n_until_found: Option<usize>,
}

impl Cut {
    /// Headings of [`cells`](Self::cells).
    pub const HEADINGS: [&'static str; 5] = [
        "frames until tracked",
        "until found in the map",
        "wrong loops",
        "ATE Sim(3) without / with loops, m",
        "largest error, m",
    ];

    /// Reads the output folders without and with, and the truth; frames come again from `until` on.
    pub fn read([without, with]: [&Path; 2], truth: &Path, until: usize) -> Result<Self, StepFailed> {
        let log = LoopLog::read(with)?;
        let frames = Table::read(&with.join("frames.csv"))?;
        let mut n_until_tracked = None;
        for [index, status] in frames.rows(["index", "status"])? {
            let index: usize = frames.number(index)?;
            if index >= until && status == "tracked" {
                n_until_tracked = Some(index - until);
                break;
            }
        }
        let mut found = log.closed.iter().map(|closed| closed.frame).filter(|&frame| frame >= until);
        Ok(Self {
            n_wrong: Judgement::of(&log, &TruePose::read(truth)?).n_wrong,
            folders: [Folder::read(without)?, Folder::read(with)?],
            largest_m: [largest_error_m(without)?, largest_error_m(with)?],
            n_until_tracked,
            n_until_found: found.next().map(|frame| frame - until),
        })
    }

    /// A cell for each heading.
    pub fn cells(&self) -> Vec<String> {
        let count = |n: Option<usize>| n.map_or_else(|| "never".to_owned(), |n| n.to_string());
        vec![
            count(self.n_until_tracked),
            count(self.n_until_found),
            self.n_wrong.to_string(),
            self.folders.each_ref().map(Folder::ate_sim3).join(" / "),
            self.largest_m.join(" / "),
        ]
    }
}

/// What `kilogs eval` printed about the frame that is farthest off, m.
fn largest_error_m(out: &Path) -> Result<String, StepFailed> {
    let path = out.join("said.txt");
    let said = std::fs::read_to_string(&path)
        .map_err(|error| StepFailed::Broken(format!("reading {}: {error}", path.display())))?;
    let line = said.lines().find_map(|line| line.trim().strip_prefix("largest"));
    Ok(line.and_then(|rest| rest.split_whitespace().next()).unwrap_or("-").to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder(files: &[(&str, String)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, text) in files {
            std::fs::write(folder.path().join(name), text).expect("a temporary file");
        }
        folder
    }

    /// A drive of 120 frames to and fro between two places, with one loop, of a run with this error.
    fn run(ate_m: f64, psnr_db: f64) -> tempfile::TempDir {
        let rows = (0..120).map(|k| match k {
            110 => "110,110,10,accepted\n".to_owned(),
            _ => format!("{k},{k},,no_candidate\n"),
        });
        let poses = (0..120).map(|k| format!("1 0 0 {} 0 1 0 0 0 0 1 0\n", 10 * (k % 100)));
        let status = |k: usize| if k < 103 { "lost" } else { "tracked" };
        folder(&[
            ("loops.csv", format!("frame,keyframe,candidate,decision\n{}", rows.collect::<String>())),
            ("poses.txt", poses.collect()),
            ("views.csv", format!("frame,psnr_db\n5,{psnr_db}\n70,3\n")),
            (
                "frames.csv",
                format!("index,status\n{}", (0..120).map(|k| format!("{k},{}\n", status(k))).collect::<String>()),
            ),
            ("report.json", r#"{"frames":{"received":120},"memory":{"rss_peak_bytes":2097152}}"#.to_owned()),
            ("eval.json", format!(r#"{{"ate_sim3_m":{ate_m}}}"#)),
            ("said.txt", "ATE RMSE   1 m\n    largest    7.5 m\n".to_owned()),
        ])
    }

    #[test]
    fn a_drive_becomes_a_row() {
        let (without, with) = (run(3.0, 20.0), run(1.0, 21.0));
        let truth = with.path().join("poses.txt");
        let drive = Drive::read([without.path(), with.path()], &truth).map_err(|e| e.to_string()).expect("figures");
        let cells = drive.cells();
        assert_eq!(cells.len(), Drive::HEADINGS.len());
        assert_eq!(
            cells[..6],
            ["120, 120", "1 / 0", "3 of 20", "1 of 1", "3.00 / 1.00", "- / -"].map(str::to_owned),
            "{cells:?}"
        );
        assert_eq!(cells[6..], ["2", "-", "20.00 / 21.00", ""].map(str::to_owned));
    }

    #[test]
    fn a_cut_becomes_a_row() {
        let (without, with) = (run(3.0, 20.0), run(1.0, 21.0));
        let truth = with.path().join("poses.txt");
        let cut = |until| Cut::read([without.path(), with.path()], &truth, until).map_err(|e| e.to_string());
        assert_eq!(cut(100).expect("figures").cells(), ["3", "10", "0", "3.00 / 1.00", "7.5 / 7.5"]);
        assert_eq!(cut(111).expect("figures").cells()[..2], ["0", "never"]);
    }
}
