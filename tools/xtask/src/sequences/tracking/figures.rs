//! The figures of one run, out of its output folder.

use crate::sequences::bench::read_text;
use crate::sequences::read_json;
use crate::step::StepFailed;
use serde_json::Value;
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// Figures of `eval.json` and `report.json`: heading, whether of `eval.json`, keys, digits.
const FIGURES: [(&str, bool, &[&str], usize); 7] = [
    ("ATE Sim(3) m", true, &["ate_sim3_m"], 3),
    ("ATE SE(3) m", true, &["ate_se3_m"], 3),
    ("scale", true, &["scale"], 4),
    ("segments %", true, &["segment_translation_percent"], 2),
    ("deg/100 m", true, &["segment_rotation_deg_per_100m"], 2),
    ("RPE deg", true, &["rpe_rotation_deg"], 3),
    ("RPE m", true, &["rpe_translation_m"], 3),
];
const LATER_FIGURES: [(&str, bool, &[&str], usize); 5] = [
    ("doubtful", false, &["frames", "doubtful"], 0),
    ("lost", false, &["frames", "lost"], 0),
    ("PSNR dB", false, &["mapping", "psnr_train_db"], 2),
    ("ms p50", false, &["time", "tracking_ms", "p50"], 1),
    ("ms p95", false, &["time", "tracking_ms", "p95"], 1),
];

/// Shares of frames: heading, column of `frames.csv`, value.
const SHARES: [(&str, &str, &str); 6] = [
    ("E %", "model", "E"),
    ("PnP %", "model", "PnP"),
    ("dense %", "model", "dense"),
    ("predicted %", "model", "predicted"),
    ("sparse tier %", "matches", "sparse"),
    ("dense tier %", "matches", "dense"),
];

/// How often each value of each column of `frames.csv` occurs.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Tally {
    n_frames: u64,
    counts: BTreeMap<(String, String), u64>,
}

/// What came out of one run.
pub(super) struct Figures {
    report: Value,
    eval: Value,
    all: Tally,
    /// Of the spoilt frames and those right behind them, what was tracked.
    spoilt: Option<Tally>,
    moved_m: Option<f64>,
}

impl Figures {
    /// Reads an output folder.
    pub fn read(out: &Path, spoilt: Option<Range<u64>>) -> Result<Self, StepFailed> {
        let report = read_json(&out.join("report.json"))?;
        let eval = read_json(&out.join("eval.json")).unwrap_or(Value::Null);
        let frames = read_text(&out.join("frames.csv"))?;
        let all = Tally::of(&frames, |_, status| status != "dropped")?;
        let in_range =
            |range: Range<u64>| Tally::of(&frames, move |index, status| range.contains(&index) && status == "tracked");
        let moved_m = moved_m(&read_text(&out.join("trajectory_tum.txt"))?);
        Ok(Self { report, eval, all, spoilt: spoilt.map(in_range).transpose()?, moved_m })
    }

    /// Headings of [`Figures::cells`].
    pub fn headings(has_spoilt: bool) -> Vec<&'static str> {
        let spoilt = ["spoilt frames and 10 after, by model", "by tier", "saved by"];
        let of = |figures: &[(&'static str, bool, &[&str], usize)]| figures.iter().map(|f| f.0).collect::<Vec<_>>();
        let shares = SHARES.map(|(heading, ..)| heading);
        let moved: &[&str] = if has_spoilt { &[] } else { &["moved m"] };
        let spoilt: &[&str] = if has_spoilt { &spoilt } else { &[] };
        [&["frames"], &of(&FIGURES)[..], moved, &shares, &of(&LATER_FIGURES), spoilt].concat()
    }

    /// A cell for each heading; a figure that could not be measured is a dash.
    pub fn cells(&self, has_spoilt: bool) -> Vec<String> {
        let number = |&(_, is_of_eval, keys, digits): &(&str, bool, &[&str], usize)| {
            let document = if is_of_eval { &self.eval } else { &self.report };
            let value = keys.iter().try_fold(document, |value, key| value.get(key)).and_then(Value::as_f64);
            value.map_or_else(|| "-".to_owned(), |number| format!("{number:.digits$}"))
        };
        let mut cells = vec![self.all.n_frames.to_string()];
        cells.extend(FIGURES.iter().map(number));
        if !has_spoilt {
            cells.push(self.moved_m.map_or_else(|| "-".to_owned(), |moved_m| format!("{moved_m:.2}")));
        }
        cells.extend(SHARES.iter().map(|(_, column, value)| self.all.share(column, value)));
        cells.extend(LATER_FIGURES.iter().map(number));
        if let Some(spoilt) = self.spoilt.as_ref().filter(|_| has_spoilt) {
            cells.extend([spoilt.list("model"), spoilt.list("matches"), spoilt.savior().to_owned()]);
        }
        cells
    }
}

impl Tally {
    /// Counts the rows of `frames.csv` that `is_wanted` by their index and status.
    fn of(csv: &str, is_wanted: impl Fn(u64, &str) -> bool) -> Result<Self, StepFailed> {
        let mut lines = csv.lines().map(|line| line.split(',').collect::<Vec<&str>>());
        let names = lines.next().unwrap_or_default();
        let column = |wanted: &str| names.iter().position(|name| *name == wanted);
        let (Some(index), Some(status)) = (column("index"), column("status")) else {
            return Err(StepFailed::Broken("frames.csv has no columns index and status".to_owned()));
        };
        let mut tally = Self::default();
        for row in lines {
            let cell = |i: usize| row.get(i).copied().unwrap_or_default();
            if !is_wanted(cell(index).parse().unwrap_or(u64::MAX), cell(status)) {
                continue;
            }
            tally.n_frames += 1;
            for name in ["model", "matches"] {
                if let Some(i) = column(name) {
                    *tally.counts.entry((name.to_owned(), cell(i).to_owned())).or_default() += 1;
                }
            }
        }
        Ok(tally)
    }

    fn count(&self, column: &str, value: &str) -> u64 {
        self.counts.get(&(column.to_owned(), value.to_owned())).copied().unwrap_or(0)
    }

    /// Percent of the frames; a dash where the column is not there.
    fn share(&self, column: &str, value: &str) -> String {
        if !self.counts.keys().any(|(name, _)| name == column) {
            return "-".to_owned();
        }
        format!("{:.1}", 100.0 * self.count(column, value) as f64 / self.n_frames.max(1) as f64)
    }

    /// Every value of a column with its count.
    fn list(&self, column: &str) -> String {
        let of_column = self.counts.iter().filter(|((name, value), _)| name == column && !value.is_empty());
        let listed: Vec<String> = of_column.map(|((_, value), n)| format!("{value} {n}")).collect();
        if listed.is_empty() { "-".to_owned() } else { listed.join(", ") }
    }

    /// The costliest tier that gave a frame its pose.
    fn savior(&self) -> &'static str {
        let tiers = [
            ("model", "dense", "dense"),
            ("matches", "dense", "dense"),
            ("matches", "sparse", "sparse"),
            ("model", "PnP", "PnP"),
            ("model", "E", "E"),
        ];
        let taken = tiers.iter().find(|(column, value, _)| self.count(column, value) > 0);
        taken.map_or("nothing", |(_, _, name)| name)
    }
}

/// Distance between the first and the last position, m.
fn moved_m(trajectory_tum: &str) -> Option<f64> {
    let position = |line: &str| -> Option<[f64; 3]> {
        let numbers: Vec<f64> = line.split_whitespace().map_while(|word| word.parse().ok()).collect();
        Some([*numbers.get(1)?, *numbers.get(2)?, *numbers.get(3)?])
    };
    let mut lines = trajectory_tum.lines().filter(|line| !line.starts_with('#'));
    let first = position(lines.next()?)?;
    let last = lines.next_back().map_or(Some(first), position)?;
    Some(first.iter().zip(last).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAMES: &str = "index,t,status,model,matches,n\n0,0,tracked,origin,tracks,9\n1,0,tracked,E,tracks,9\n\
                          2,0,tracked,PnP,sparse,9\n3,0,doubtful,predicted,tracks,9\n4,0,dropped,,,\n5,0,tracked,E,tracks,9\n";

    fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, text) in files {
            std::fs::write(folder.path().join(name), text).expect("a temporary file");
        }
        folder
    }

    #[test]
    fn a_run_becomes_a_row() {
        let report =
            r#"{"frames":{"doubtful":1,"lost":0},"time":{"tracking_ms":{"p50":15.27,"p95":41.0}},"mapping":{}}"#;
        let trajectory = "0 1 0 0 0 0 0 1\n1 2 0 0 0 0 0 1\n2 4 4 0 0 0 0 1\n";
        let files = [("report.json", report), ("frames.csv", FRAMES), ("trajectory_tum.txt", trajectory)];
        let without_truth = Figures::read(folder(&files).path(), None).map(|figures| figures.cells(false).join(" "));
        assert_eq!(
            without_truth.map_err(|e| e.to_string()),
            Ok("5 - - - - - - - 5.00 40.0 20.0 0.0 20.0 20.0 0.0 1 0 - 15.3 41.0".to_owned())
        );
        let eval = [&files[..], &[("eval.json", r#"{"ate_sim3_m":0.1234,"scale":1.01}"#)]].concat();
        let spoilt = Figures::read(folder(&eval).path(), Some(1..4)).map(|figures| figures.cells(true));
        let cells = spoilt.map_err(|e| e.to_string()).expect("a row");
        assert_eq!(cells.len(), Figures::headings(true).len());
        assert_eq!(cells[1..4], ["0.123", "-", "1.0100"]);
        assert_eq!(cells[cells.len() - 3..], ["E 1, PnP 1", "sparse 1, tracks 1", "sparse"]);
    }

    #[test]
    fn who_saved_the_frames_is_told() {
        let check = |rows: &str, expected: &str| {
            let tally = Tally::of(&format!("index,status,model,matches\n{rows}"), |_, _| true).expect("columns");
            assert_eq!(tally.savior(), expected, "{rows}");
        };
        check("", "nothing");
        check("0,tracked,E,tracks\n", "E");
        check("0,tracked,E,tracks\n1,tracked,PnP,tracks\n", "PnP");
        check("0,tracked,E,sparse\n1,tracked,PnP,tracks\n", "sparse");
        check("0,tracked,E,dense\n1,tracked,PnP,sparse\n", "dense");
        assert!(Tally::of("t,model\n", |_, _| true).is_err());
    }

    #[test]
    fn a_column_that_is_not_there_is_a_dash() {
        let tally = Tally::of("index,status,model\n0,tracked,E\n", |_, _| true).expect("columns");
        assert_eq!((tally.share("matches", "dense"), tally.share("model", "E")), ("-".to_owned(), "100.0".to_owned()));
    }
}
