//! What came of it, for people.

use super::renew::RenewCounts;
use super::trainer::TrainingCounts;
use crate::map_store::{MapStoreReader, StoreBytes};
use crate::render_views::MapQuality;
use std::fmt;

/// A map before or after.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Scores {
    /// PSNR of the mapping keyframes, dB.
    pub psnr_train_db: Option<f64>,
    /// SSIM of the mapping keyframes.
    pub ssim_train: Option<f64>,
    /// PSNR of the held-out views, dB.
    pub psnr_heldout_db: Option<f64>,
    /// SSIM of the held-out views.
    pub ssim_heldout: Option<f64>,
    /// PSNR of the worst 100 m, dB.
    pub psnr_worst_100m_db: Option<f64>,
    /// Gaussians in the map.
    pub gaussians: u64,
    /// Bytes of pages and chunks.
    pub map_bytes: u64,
    /// Bytes of all files.
    pub store_bytes: u64,
}

impl Scores {
    pub(super) fn new(map: &MapStoreReader, quality: &MapQuality, bytes: StoreBytes) -> Self {
        Self {
            psnr_train_db: quality.train.psnr_db(),
            ssim_train: quality.train.ssim(),
            psnr_heldout_db: quality.held_out.psnr_db(),
            ssim_heldout: quality.held_out.ssim(),
            psnr_worst_100m_db: quality.train.worst_stretch_db(),
            gaussians: map.pages().iter().map(|page| u64::from(page.n_gaussians)).sum(),
            map_bytes: bytes.map_bytes,
            store_bytes: bytes.store_bytes,
        }
    }
}

/// What refining achieved; prints as a table.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefineSummary {
    /// The map as it was.
    pub before: Scores,
    /// The map as it is.
    pub after: Scores,
    /// What was done.
    pub training: TrainingCounts,
}

impl fmt::Display for RefineSummary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let real = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
        let thousandths = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.3}"));
        let megabytes = |bytes: u64| format!("{:.1}", bytes as f64 / 1e6);
        let column = |s: &Scores| {
            [
                real(s.psnr_train_db),
                real(s.psnr_heldout_db),
                real(s.psnr_worst_100m_db),
                thousandths(s.ssim_train),
                thousandths(s.ssim_heldout),
                s.gaussians.to_string(),
                megabytes(s.map_bytes),
                megabytes(s.store_bytes),
            ]
        };
        writeln!(f, "{:<28} {:>10} {:>10}", "", "before", "after")?;
        for ((name, before), after) in ROWS.iter().zip(column(&self.before)).zip(column(&self.after)) {
            writeln!(f, "{name:<28} {before:>10} {after:>10}")?;
        }
        let TrainingCounts { steps, training, parts, renewed, .. } = self.training;
        let RenewCounts { guilty, faint, least_seen, densified } = renewed;
        writeln!(
            f,
            "anchors ended: {guilty} by their score, {faint} faint or oversized, {least_seen} over the limit; {densified} split"
        )?;
        let seconds = training.as_secs_f64();
        let rate = steps as f64 / seconds.max(1e-3);
        writeln!(f, "{steps} steps in {seconds:.0} s ({rate:.1} per s), {parts} parts stored")
    }
}

/// Rows of the table.
const ROWS: [&str; 8] = [
    "PSNR on keyframes, dB",
    "PSNR held out, dB",
    "PSNR of the worst 100 m, dB",
    "SSIM on keyframes",
    "SSIM held out",
    "Gaussians",
    "map, MB",
    "store, MB",
];

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    #[test]
    fn the_table_says_what_changed() {
        let before = Scores { psnr_train_db: Some(16.021), gaussians: 1200, map_bytes: 1_500_000, ..Scores::default() };
        let after = Scores { psnr_train_db: Some(20.5), gaussians: 900, ..before };
        let training =
            TrainingCounts { steps: 100, training: Duration::from_secs(10), parts: 3, ..TrainingCounts::default() };
        let table = RefineSummary { before, after, training }.to_string();
        for line in [
            "PSNR on keyframes, dB             16.02      20.50",
            "PSNR held out, dB                     -          -",
            "Gaussians                          1200        900",
            "map, MB                             1.5        1.5",
            "100 steps in 10 s (10.0 per s), 3 parts stored",
        ] {
            assert!(table.lines().any(|found| found == line), "no line {line:?} in\n{table}");
        }
    }
}
