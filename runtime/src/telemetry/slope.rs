//! Does memory grow with the distance driven? A straight line through the samples, in constant space.

/// Distance at the start that does not count: pools fill and caches warm.
const WARM_UP_M: f64 = 300.0;

/// A line through less than this says nothing.
const SHORTEST_DRIVE_M: f64 = 600.0;

/// Least squares of resident bytes over distance, without keeping the samples.
///
/// # Source
/// Welford 1962 (running means), extended to the co-moment as in Chan, Golub & LeVeque 1983, eq. 1.5b.
#[derive(Debug, Clone, Default)]
pub struct RssSlope {
    n_samples: f64,
    mean_distance_m: f64,
    mean_bytes: f64,
    distance_moment: f64,
    co_moment: f64,
    farthest_m: f64,
}

impl RssSlope {
    /// Takes one sample; those of the first 300 m only count as distance.
    pub fn push(&mut self, distance_m: f64, rss_bytes: u64) {
        self.farthest_m = self.farthest_m.max(distance_m);
        if distance_m.is_nan() || distance_m < WARM_UP_M {
            return;
        }
        self.n_samples += 1.0;
        let distance_step = distance_m - self.mean_distance_m;
        let bytes_step = rss_bytes as f64 - self.mean_bytes;
        self.mean_distance_m += distance_step / self.n_samples;
        self.mean_bytes += bytes_step / self.n_samples;
        self.distance_moment += distance_step * (distance_m - self.mean_distance_m);
        self.co_moment += distance_step * (rss_bytes as f64 - self.mean_bytes);
    }

    /// Bytes per kilometre; `None` for a drive below 600 m, or one that stood still after the warm-up.
    pub fn bytes_per_km(&self) -> Option<f64> {
        let measurable = self.farthest_m >= SHORTEST_DRIVE_M && self.distance_moment > 0.0;
        measurable.then(|| self.co_moment / self.distance_moment * 1000.0)
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
        slope.bytes_per_km()
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
    fn standing_still_after_the_warm_up_is_no_slope() {
        let mut slope = RssSlope::default();
        slope.push(700.0, 5);
        slope.push(700.0, 900);
        slope.push(f64::NAN, 900);
        assert_eq!(slope.bytes_per_km(), None);
    }
}
