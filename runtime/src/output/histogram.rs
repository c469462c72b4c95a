//! Percentiles of durations in constant memory.

use super::report::Percentiles;

/// Shortest duration that is told apart from 0, ms.
const SMALLEST_MS: f64 = 1e-3;
/// Each bucket is this much wider than the one before it: percentiles are exact to half of that, 1 %.
const GROWTH: f64 = 1.02;
/// Enough buckets for an hour: `ln(3.6e6 / 1e-3) / ln(1.02)` is 1111.
const N_BUCKETS: usize = 1120;

/// Counts durations in buckets of constant relative width; maximum and count are exact.
#[derive(Clone, Debug)]
pub struct Histogram {
    buckets: Box<[u64; N_BUCKETS]>,
    n: u64,
    max_ms: f64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self { buckets: Box::new([0; N_BUCKETS]), n: 0, max_ms: 0.0 }
    }
}

impl Histogram {
    /// Adds a duration; NaN is not counted. Takes no memory.
    pub fn push(&mut self, ms: f64) {
        if ms.is_nan() {
            return;
        }
        // A float below 0 or above the range becomes the nearest integer of the range.
        let bucket = ((ms / SMALLEST_MS).ln() / GROWTH.ln()).ceil() as usize;
        self.buckets[bucket.min(N_BUCKETS - 1)] += 1;
        self.n += 1;
        self.max_ms = self.max_ms.max(ms);
    }

    /// Durations seen.
    pub fn count(&self) -> u64 {
        self.n
    }

    /// The duration that `fraction` of all do not exceed (nearest rank); `None` when there are none.
    pub fn percentile_ms(&self, fraction: f64) -> Option<f64> {
        let rank = ((fraction * self.n as f64).ceil() as u64).clamp(1, self.n.max(1));
        let mut seen = 0;
        let bucket = self.buckets.iter().position(|count| {
            seen += count;
            seen >= rank
        })?;
        let upper_ms = SMALLEST_MS * GROWTH.powi(bucket as i32);
        let middle_ms = if bucket == 0 { 0.0 } else { upper_ms / GROWTH.sqrt() };
        Some(middle_ms.min(self.max_ms))
    }

    /// Median, 95th percentile and maximum.
    pub fn percentiles(&self) -> Percentiles {
        Percentiles {
            p50: self.percentile_ms(0.50),
            p95: self.percentile_ms(0.95),
            max: (self.n > 0).then_some(self.max_ms),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_within_a_percent_of_the_sorted_values() {
        let check = |values: &[f64]| {
            let mut histogram = Histogram::default();
            values.iter().for_each(|&ms| histogram.push(ms));
            let mut sorted = values.to_vec();
            sorted.sort_by(f64::total_cmp);
            for fraction in [0.01, 0.5, 0.95, 1.0] {
                let exact = sorted[((fraction * sorted.len() as f64).ceil() as usize).max(1) - 1];
                let found = histogram.percentile_ms(fraction).expect("not empty");
                assert!((found - exact).abs() <= 0.01 * exact + SMALLEST_MS, "{fraction}: {found}, exact {exact}");
            }
            assert_eq!(histogram.percentiles().max, sorted.last().copied());
        };
        check(&[7.0]);
        check(&[0.0, 0.0, 5.0]);
        check(&(1..=2000).map(|k| 0.05 * f64::from(k * k % 2003)).collect::<Vec<_>>());
        check(&[1e-9, 0.001, 1.0, 3.5e6]);
    }

    #[test]
    fn nothing_and_nonsense_have_no_percentiles() {
        let mut histogram = Histogram::default();
        histogram.push(f64::NAN);
        assert_eq!((histogram.count(), histogram.percentiles()), (0, Percentiles::default()));
        histogram.push(f64::INFINITY);
        histogram.push(-1.0);
        assert_eq!(histogram.count(), 2);
    }
}
