//! The figures of one arm, out of its report, of what its map was judged by, and of what refining printed.

use serde_json::Value;

/// Headings of [`Figures::cells`].
pub(super) const HEADINGS: [&str; 13] = [
    "PSNR / held out, dB",
    "SSIM / held out",
    "LPIPS / held out",
    "refined: PSNR / held out, dB",
    "SSIM / held out",
    "worst 100 m, dB",
    "anchors",
    "Gaussians",
    "refined",
    "map MB",
    "RSS MB",
    "it/s",
    "wall s",
];

/// What came out of one arm.
pub(super) struct Figures {
    report: Value,
    judged: Value,
    refined: String,
}

impl Figures {
    /// Out of `report.json`, `eval.json` and of what `kilogs refine` printed, which may be nothing.
    pub fn new(report: Value, judged: Value, refined: &str) -> Self {
        Self { report, judged, refined: refined.to_owned() }
    }

    /// A cell for each heading; a figure that could not be measured is a dash.
    pub fn cells(&self) -> Vec<String> {
        let mapping = |key: &str, digits: usize| self.reported(&["mapping", key], digits, 1.0);
        let judged = |key: &str| written(self.judged[key].as_f64(), 3);
        let pair = |first: String, second: String| format!("{first} / {second}");
        vec![
            pair(mapping("psnr_train_db", 2), mapping("psnr_heldout_db", 2)),
            pair(mapping("ssim_train", 3), mapping("ssim_heldout", 3)),
            pair(judged("lpips_train"), judged("lpips_heldout")),
            pair(self.after("PSNR on keyframes, dB"), self.after("PSNR held out, dB")),
            pair(self.after("SSIM on keyframes"), self.after("SSIM held out")),
            self.after("PSNR of the worst 100 m, dB"),
            mapping("anchors_total", 0),
            mapping("gaussians", 0),
            self.after("Gaussians"),
            self.reported(&["mapping", "map_bytes"], 1, 1e-6),
            self.reported(&["memory", "rss_peak_bytes"], 0, 1e-6),
            self.reported(&["time", "mapping_it_per_s"], 1, 1.0),
            self.reported(&["time", "wall_s"], 0, 1.0),
        ]
    }

    fn reported(&self, keys: &[&str], digits: usize, unit: f64) -> String {
        let value = keys.iter().try_fold(&self.report, |value, key| value.get(key)).and_then(Value::as_f64);
        written(value.map(|number| number * unit), digits)
    }

    /// The last word of a row of the table that refining prints.
    fn after(&self, row: &str) -> String {
        let line = self.refined.lines().find_map(|line| line.strip_prefix(row));
        line.and_then(|rest| rest.split_whitespace().nth(1)).unwrap_or("-").to_owned()
    }
}

fn written(number: Option<f64>, digits: usize) -> String {
    number.map_or_else(|| "-".to_owned(), |number| format!("{number:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_arm_becomes_a_row() {
        let report = serde_json::json!({
            "mapping": { "psnr_train_db": 19.504, "gaussians": 1200, "map_bytes": 3_400_000 },
            "memory": { "rss_peak_bytes": 2e8 },
        });
        let refined =
            "                before  after\nPSNR on keyframes, dB   19.50   22.44\nGaussians    1200    900\n";
        let judged = serde_json::json!({ "lpips_train": 0.26812, "lpips_heldout": null });
        let cells = Figures::new(report, judged, refined).cells();
        assert_eq!(cells[0], "19.50 / -");
        assert_eq!(cells[2..4], ["0.268 / -", "22.44 / -"]);
        assert_eq!(cells[6..], ["-", "1200", "900", "3.4", "200", "-", "-"]);
    }
}
