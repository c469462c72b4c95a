//! Does memory grow with the distance driven? A straight line through the samples, in constant space.

use std::fmt;

/// Distance at the start that does not count: pools fill and caches warm.
const WARM_UP_M: f64 = 300.0;

/// A line through less than this says nothing.
const SHORTEST_DRIVE_M: f64 = 600.0;

const M_PER_KM: f64 = 1000.0;

/// Growth per kilometre, and how far chance alone moves it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Growth {
    /// Bytes per kilometre.
    pub bytes_per_km: f64,
    /// Standard error of that; infinite for fewer than three samples.
    pub sigma: f64,
}

impl fmt::Display for Growth {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [kib_per_km, sigma_kib] = [self.bytes_per_km, self.sigma].map(|bytes| bytes / f64::from(1 << 10));
        write!(f, "{kib_per_km:+.0} KiB per km, ")?;
        if sigma_kib.is_finite() {
            write!(f, "standard error {sigma_kib:.0} KiB")
        } else {
            write!(f, "in too few steps for a standard error")
        }
    }
}

/// Least squares of resident bytes over distance, without keeping the samples.
///
/// Memory moves in steps, so a sample is much like the one before; the standard error counts fewer independent samples for
/// it, by the correlation of neighbouring residuals.
///
/// # Source
/// Welford 1962 (running means), extended to the co-moment as in Chan, Golub & LeVeque 1983, eq. 1.5b; Bayley & Hammersley
/// 1946 (effective number of observations, first-order process).
#[derive(Debug, Clone, Default)]
pub struct RssSlope {
    n_samples: f64,
    mean_distance_m: f64,
    mean_bytes: f64,
    distance_moment: f64,
    byte_moment: f64,
    co_moment: f64,
    /// The first sample, and sums of products with the sample before, both seen from the first: distance with distance,
    /// distance with bytes, bytes with distance, bytes with bytes.
    first: [f64; 2],
    before: [f64; 2],
    lagged: [[f64; 2]; 2],
    farthest_m: f64,
}

impl RssSlope {
    /// Takes one sample; those of the first 300 m only count as distance.
    pub fn push(&mut self, distance_m: f64, rss_bytes: u64) {
        self.farthest_m = self.farthest_m.max(distance_m);
        if distance_m.is_nan() || distance_m < WARM_UP_M {
            return;
        }
        if self.n_samples == 0.0 {
            self.first = [distance_m, rss_bytes as f64];
        }
        let sample = [distance_m - self.first[0], rss_bytes as f64 - self.first[1]];
        for (row, now) in self.lagged.iter_mut().zip(sample) {
            row.iter_mut().zip(self.before).for_each(|(sum, before)| *sum += now * before);
        }
        self.before = sample;
        self.n_samples += 1.0;
        let distance_step = distance_m - self.mean_distance_m;
        let bytes_step = rss_bytes as f64 - self.mean_bytes;
        self.mean_distance_m += distance_step / self.n_samples;
        self.mean_bytes += bytes_step / self.n_samples;
        self.distance_moment += distance_step * (distance_m - self.mean_distance_m);
        self.byte_moment += bytes_step * (rss_bytes as f64 - self.mean_bytes);
        self.co_moment += distance_step * (rss_bytes as f64 - self.mean_bytes);
    }

    /// The growth; `None` for a drive below 600 m, or one that stood still after the warm-up.
    pub fn growth(&self) -> Option<Growth> {
        let measurable = self.farthest_m >= SHORTEST_DRIVE_M && self.distance_moment > 0.0;
        let slope = measurable.then(|| self.co_moment / self.distance_moment)?;
        let residual_moment = (self.byte_moment - slope * self.co_moment).max(0.0);
        let correlation = if residual_moment > 0.0 { self.lagged_residuals(slope) / residual_moment } else { 0.0 };
        let correlation = correlation.clamp(0.0, 1.0 - f64::EPSILON);
        let n_independent = self.n_samples * (1.0 - correlation) / (1.0 + correlation);
        let variance = residual_moment / self.distance_moment / (n_independent - 2.0).max(0.0);
        let sigma = if residual_moment > 0.0 { variance.sqrt() } else { 0.0 };
        Some(Growth { bytes_per_km: slope * M_PER_KM, sigma: sigma * M_PER_KM })
    }

    /// Sum of the products of neighbouring residuals, but for what the samples at both ends add.
    fn lagged_residuals(&self, slope: f64) -> f64 {
        let offset = self.mean_bytes - self.first[1] - slope * (self.mean_distance_m - self.first[0]);
        let [[xx, xy], [yx, yy]] = self.lagged;
        yy - slope * (yx + xy) + slope * slope * xx - self.n_samples * offset * offset
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Slope over a drive of `length_m` with a sample every 10 m.
    fn slope_of(length_m: u32, rss_bytes: impl Fn(f64) -> f64) -> Option<f64> {
        let mut slope = RssSlope::default();
        for distance_m in (0..=length_m).step_by(10).map(f64::from) {
            slope.push(distance_m, rss_bytes(distance_m) as u64);
        }
        slope.growth().map(|g| g.bytes_per_km)
    }

    #[test]
    fn a_line_is_found_and_the_warm_up_is_not_part_of_it() {
        let check = |length_m, rss: fn(f64) -> f64, expected: Option<f64>| {
            let found = slope_of(length_m, rss);
            let close = match (found, expected) {
                (Some(found), Some(expected)) => (found - expected).abs() < 1e-3 * (1.0 + expected.abs()),
                (found, expected) => found == expected,
            };
            assert!(close, "{length_m} m: {found:?}, expected {expected:?}");
        };
        check(2000, |_| 4e8, Some(0.0));
        check(2000, |m| 4e8 + 500.0 * m, Some(5e5));
        check(2000, |m| 4e8 - 500.0 * m, Some(-5e5));
        check(2000, |m| if m < 300.0 { 1e6 * m } else { 4e8 }, Some(0.0));
        check(600, |m| 4e8 + 100.0 * m, Some(1e5));
        check(590, |m| 4e8 + 100.0 * m, None);
        check(0, |_| 4e8, None);
    }

    #[test]
    fn growth_is_told_with_its_error_or_without() {
        let told = |sigma| Growth { bytes_per_km: -2048.0, sigma }.to_string();
        assert_eq!(told(1024.0), "-2 KiB per km, standard error 1 KiB");
        assert_eq!(told(f64::INFINITY), "-2 KiB per km, in too few steps for a standard error");
    }

    #[test]
    fn standing_still_after_the_warm_up_is_no_slope() {
        let mut slope = RssSlope::default();
        slope.push(700.0, 5);
        slope.push(700.0, 900);
        slope.push(f64::NAN, 900);
        assert_eq!(slope.growth(), None);
    }
    /// Residuals as a walk that forgets by `memory` from sample to sample: the error that is told covers the one that is made.
    #[test]
    fn the_error_is_told_for_noise_and_for_steps() {
        for memory in [0.0, 0.9] {
            let mut n_covered = 0;
            const DRIVES: u64 = 200;
            for drive in 0..DRIVES {
                let mut rng = kilogs_core::math::Rng::new(5, drive, 0);
                let (mut slope, mut off) = (RssSlope::default(), 0.0);
                for distance_m in (300..=2000).step_by(10).map(f64::from) {
                    off = memory * off + 2e5 * (rng.unit_f64() - 0.5);
                    slope.push(distance_m, (4e8 + off) as u64);
                }
                let Growth { bytes_per_km, sigma } = slope.growth().expect("a drive of 2 km");
                n_covered += u64::from(bytes_per_km.abs() < 2.0 * sigma);
            }
            // 95 % of normal errors are within two deviations; the correlation is itself estimated.
            assert!((170..200).contains(&n_covered), "memory {memory}: {n_covered} of {DRIVES}");
        }
    }
}
