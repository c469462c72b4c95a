//! Merges uncertain measurements of the scale into one that drifts slowly.

use super::sources::{ScaleMeasurement, ScaleSource};

/// How the odometry's own scale drifts, and how far a measurement is trusted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleFilterSettings {
    /// Standard deviation of the natural logarithm of the scale before the first measurement. Range 0.1..3.
    pub first_sigma: f64,
    /// Random drift of the logarithm per square root of a metre driven. Range 0.0001..0.05.
    pub drift_per_sqrt_m: f64,
    /// Random drift of the logarithm per square root of a radian turned, where landmarks change within a few keyframes.
    /// Range 0..0.2.
    pub turn_drift_per_sqrt_rad: f64,
    /// Standard deviation of the constant part of the drift before the first measurement, 1/m. Range 0..0.01.
    pub drift_rate_sigma_per_m: f64,
    /// Random change of that constant part per square root of a metre, 1/m. Range 0..0.001.
    pub drift_rate_change_per_m: f64,
    /// Standard deviation of the road measurements of one stretch. Range 0.005..0.3.
    pub measurement_sigma: f64,
    /// The same of a depth network. Range 0.005..0.3.
    pub network_sigma: f64,
    /// The same of wheels, whose tyres wear. Range 0.001..0.3.
    pub wheel_sigma: f64,
    /// Length of a stretch, m: measurements closer than this share their errors (crown, slope, kerb), so that
    /// several of them weigh no more than one. Range 0..100.
    pub correlation_m: f64,
    /// Additional standard deviation of the first measurement of a camera's source; the n-th has it divided by n. Range 0..1.
    pub early_sigma: f64,
    /// Width of the Cauchy kernel in standard deviations: measurements beyond it lose their weight. Range 1..5.
    pub kernel_sigmas: f64,
    /// Factor beyond which a measurement is no scale at all and is rejected. Range 1.05..10.
    pub max_jump: f64,
    /// Innovation in standard deviations beyond which a measurement is rejected while another source vouches for the
    /// scale; one source alone has to be able to correct it. Range 2..10.
    pub gate_sigmas: f64,
}

impl ScaleFilterSettings {
    /// Standard deviation of a source's measurements of one stretch.
    pub fn sigma_of(&self, source: ScaleSource) -> f64 {
        match source {
            ScaleSource::GroundPlane => self.measurement_sigma,
            ScaleSource::DepthNetwork => self.network_sigma,
            ScaleSource::WheelSpeed => self.wheel_sigma,
        }
    }
}

/// What became of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ScaleUpdate {
    /// The factor by which lengths are to be multiplied from now on.
    Accept {
        /// Multiplies all lengths.
        correction: f64,
        /// Weight that the robust kernel left, 0 to 1.
        weight: f64,
        /// Kalman gains of the logarithm of the scale and of its drift, 1/m: shares of the measured error that they
        /// took over.
        gains: [f64; 2],
    },
    /// The measurement jumps implausibly, or disagrees with what another source vouches for.
    Reject {
        /// Natural logarithm of the measured factor.
        log_ratio: f64,
        /// What was allowed.
        limit: f64,
    },
}

/// Kalman filter on the logarithm of (true length / length in the odometry's scale) and its drift per metre.
///
/// The caller applies each correction to its window, so the expected logarithm is always zero and only its
/// variance is kept. The drift has a constant part because a monocular odometry's errors do not average out: on
/// KITTI the scale of landmarks alone grows by about 0.04 % per metre.
///
/// Sources are merged one after the other, each by its variance. Every source has its own stretch, because errors of the
/// road say nothing about those of the wheels.
///
/// # Source
/// Kalman 1960, in two states; the robust weight is Cauchy's, applied to the innovation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleFilter {
    drift_rate_per_m: f64,
    variance: f64,
    covariance: f64,
    rate_variance: f64,
    /// Squared innovations over their variance, averaged over the last stretches.
    surprise: f64,
    n_measurements: [u32; ScaleSource::N],
    /// Driven since the last accepted measurement of each source, m.
    unmeasured_m: [f64; ScaleSource::N],
}

/// Share of the average surprise that the newest measurement makes up.
const NEWEST_SURPRISE: f64 = 0.2;

impl ScaleFilter {
    /// A filter that knows nothing.
    pub fn new(settings: &ScaleFilterSettings) -> Self {
        Self {
            drift_rate_per_m: 0.0,
            variance: settings.first_sigma * settings.first_sigma,
            covariance: 0.0,
            rate_variance: settings.drift_rate_sigma_per_m * settings.drift_rate_sigma_per_m,
            surprise: 1.0,
            n_measurements: [0; ScaleSource::N],
            unmeasured_m: [0.0; ScaleSource::N],
        }
    }

    /// Standard deviation of the logarithm of the scale; it grows where measurements have been off by more than they claim.
    pub fn sigma(&self) -> f64 {
        libm::sqrt(self.variance * self.surprise.max(1.0))
    }

    /// Variance of the logarithm of the scale.
    pub fn variance(&self) -> f64 {
        self.variance
    }

    /// Covariance of that logarithm with its drift, 1/m.
    pub fn covariance_with_rate(&self) -> f64 {
        self.covariance
    }

    /// Measurements that were merged.
    pub fn n_measurements(&self) -> u32 {
        self.n_measurements.into_iter().fold(0, u32::saturating_add)
    }

    /// Expected drift of the logarithm, 1/m.
    pub fn drift_rate_per_m(&self) -> f64 {
        self.drift_rate_per_m
    }

    /// Lets the scale drift over a distance driven and an angle turned; returns the factor that undoes the expected
    /// drift.
    pub fn drive(&mut self, distance_m: f64, turn_rad: f64, settings: &ScaleFilterSettings) -> f64 {
        if !(distance_m.is_finite() && distance_m > 0.0 && turn_rad.is_finite()) {
            return 1.0;
        }
        let turning = settings.turn_drift_per_sqrt_rad * settings.turn_drift_per_sqrt_rad * turn_rad.abs();
        let random = settings.drift_per_sqrt_m * settings.drift_per_sqrt_m * distance_m + turning;
        let change = settings.drift_rate_change_per_m * settings.drift_rate_change_per_m * distance_m;
        let ceiling = settings.first_sigma * settings.first_sigma;
        self.variance += distance_m * (2.0 * self.covariance + distance_m * self.rate_variance) + random;
        self.variance = self.variance.clamp(f64::MIN_POSITIVE, ceiling);
        self.covariance += distance_m * self.rate_variance;
        self.rate_variance += change;
        self.unmeasured_m.iter_mut().for_each(|way_m| *way_m += distance_m);
        libm::exp(self.drift_rate_per_m * distance_m)
    }

    /// Merges one measurement of the factor (true length / length in the current scale); a ratio that is not above 0 is
    /// rejected.
    pub fn update(&mut self, measured: &ScaleMeasurement, settings: &ScaleFilterSettings) -> ScaleUpdate {
        let (log_ratio, place) = (libm::log(measured.ratio), measured.source.place());
        let (Some(&n_before), Some(&unmeasured_m)) = (self.n_measurements.get(place), self.unmeasured_m.get(place))
        else {
            return ScaleUpdate::Reject { log_ratio, limit: 0.0 };
        };
        // The way that wheels roll is no worse in the beginning.
        let is_seen = measured.source != ScaleSource::WheelSpeed;
        let early = if is_seen { settings.early_sigma / f64::from(n_before + 1) } else { 0.0 };
        let shared = (settings.correlation_m / unmeasured_m).max(1.0);
        let source_sigma = settings.sigma_of(measured.source);
        let noise =
            source_sigma * source_sigma * shared + measured.relative_sigma * measured.relative_sigma + early * early;
        let limit = self.limit(place, noise, settings);
        if !log_ratio.is_finite() || !noise.is_finite() || log_ratio.abs() > limit {
            return ScaleUpdate::Reject { log_ratio, limit };
        }
        self.note_measured(place);
        let sigmas2 = log_ratio * log_ratio / (self.variance + noise);
        self.surprise += NEWEST_SURPRISE * (sigmas2 - self.surprise);
        let weight = 1.0 / (1.0 + sigmas2 / (settings.kernel_sigmas * settings.kernel_sigmas));
        let total = self.variance + noise / weight;
        let (gain, rate_gain) = (self.variance / total, self.covariance / total);
        self.drift_rate_per_m += rate_gain * log_ratio;
        self.rate_variance -= rate_gain * self.covariance;
        self.covariance *= 1.0 - gain;
        self.variance *= 1.0 - gain;
        ScaleUpdate::Accept { correction: libm::exp(gain * log_ratio), weight, gains: [gain, rate_gain] }
    }

    /// How far the logarithm of a measurement may be off: anywhere at first, then by no jump, and only within its own
    /// uncertainty and that of the scale where another source has just been merged.
    fn limit(&self, place: usize, noise: f64, settings: &ScaleFilterSettings) -> f64 {
        if self.n_measurements() == 0 {
            return f64::INFINITY;
        }
        let others =
            self.n_measurements.iter().zip(&self.unmeasured_m).enumerate().filter(|(other, _)| *other != place);
        let is_vouched = others.into_iter().any(|(_, (&n, &way_m))| n > 0 && way_m <= settings.correlation_m);
        let gate = settings.gate_sigmas * libm::sqrt(self.variance + noise);
        libm::log(settings.max_jump).min(if is_vouched { gate } else { f64::INFINITY })
    }

    fn note_measured(&mut self, place: usize) {
        if let (Some(n), Some(way_m)) = (self.n_measurements.get_mut(place), self.unmeasured_m.get_mut(place)) {
            (*n, *way_m) = (n.saturating_add(1), 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: ScaleFilterSettings = ScaleFilterSettings {
        first_sigma: 1.0,
        drift_per_sqrt_m: 0.002,
        turn_drift_per_sqrt_rad: 0.04,
        drift_rate_sigma_per_m: 0.001,
        drift_rate_change_per_m: 0.00002,
        measurement_sigma: 0.03,
        network_sigma: 0.05,
        wheel_sigma: 0.01,
        correlation_m: 10.0,
        early_sigma: 0.1,
        kernel_sigmas: 2.0,
        max_jump: 1.5,
        gate_sigmas: 4.0,
    };

    fn road(ratio: f64, relative_sigma: f64) -> ScaleMeasurement {
        ScaleMeasurement { ratio, relative_sigma, source: ScaleSource::GroundPlane }
    }

    /// Drives with a scale that starts off by 0.8 and grows by `drift` per metre; `measure` distorts the true
    /// factor. Returns the worst error of the logarithm over the last half.
    fn worst_error(n: usize, drift: f64, measure: impl Fn(usize, f64) -> f64) -> f64 {
        let mut filter = ScaleFilter::new(&SETTINGS);
        let (mut scale, mut worst) = (0.8_f64, 0.0_f64);
        for i in 0..n {
            scale *= libm::exp(drift * 2.0);
            scale *= filter.drive(2.0, 0.0, &SETTINGS);
            if let ScaleUpdate::Accept { correction, .. } =
                filter.update(&road(measure(i, 1.0 / scale), 0.0), &SETTINGS)
            {
                scale *= correction;
            }
            if 2 * i > n {
                worst = worst.max(libm::log(scale).abs());
            }
        }
        worst
    }

    fn alternating(i: usize, ratio: f64) -> f64 {
        if i.is_multiple_of(2) { ratio * 1.03 } else { ratio / 1.03 }
    }

    #[test]
    fn a_wrong_start_is_corrected_and_noise_is_averaged() {
        assert!(worst_error(100, 0.0, alternating) < 0.01);
    }

    #[test]
    fn a_constant_drift_is_learnt() {
        // Without the drift's own state the error would settle near drift / gain, above 2 %.
        let error = worst_error(200, 0.0005, alternating);
        assert!(error < 0.01, "{error}");
    }

    #[test]
    fn a_stretch_of_bad_measurements_does_little() {
        let error = worst_error(200, 0.0, |i, ratio| if i % 50 > 40 { ratio * 0.75 } else { alternating(i, ratio) });
        // Half of what the bad tenth of the measurements would pull a plain average of a stretch by.
        assert!(error < 0.06, "{error}");
    }

    #[test]
    fn a_measurement_counts_by_the_way_since_the_one_before() {
        let gain = |steps_m: &[f64], ratio_between: Option<f64>| {
            let mut filter = ScaleFilter::new(&SETTINGS);
            filter.drive(2.0, 0.0, &SETTINGS);
            filter.update(&road(1.0, 0.0), &SETTINGS);
            for &step_m in steps_m {
                filter.drive(step_m, 0.0, &SETTINGS);
                if let Some(ratio) = ratio_between {
                    filter.update(&road(ratio, 0.0), &SETTINGS);
                }
            }
            match filter.update(&road(1.0, 0.0), &SETTINGS) {
                ScaleUpdate::Accept { gains, .. } => gains[0],
                ScaleUpdate::Reject { .. } => f64::NAN,
            }
        };
        let (whole, halves) = (gain(&[4.0], None), gain(&[2.0, 2.0], None));
        assert!((whole / halves - 1.0).abs() < 1e-2, "{whole} {halves}");
        // A measurement that is rejected measures nothing.
        let rejected = gain(&[2.0, 2.0], Some(9.0));
        assert!((rejected / halves - 1.0).abs() < 1e-9, "{rejected} {halves}");
        assert!(gain(&[2.0], None) < halves);
    }

    #[test]
    fn nonsense_is_rejected() {
        let mut filter = ScaleFilter::new(&SETTINGS);
        let rejects = |filter: &mut ScaleFilter, ratio: f64, sigma: f64| {
            filter.drive(1.0, 0.0, &SETTINGS);
            matches!(filter.update(&road(ratio, sigma), &SETTINGS), ScaleUpdate::Reject { .. })
        };
        for ratio in [f64::NAN, 0.0, -1.0, f64::INFINITY] {
            assert!(rejects(&mut filter, ratio, 0.0), "{ratio}");
        }
        assert!(rejects(&mut filter, 1.0, f64::NAN));
        assert!(!rejects(&mut filter, 3.0, 0.0), "the first measurement may be anywhere");
        assert!(rejects(&mut filter, 1.6, 0.0), "a later one may not jump");
        assert_eq!(filter.drive(f64::NAN, 0.0, &SETTINGS), 1.0);
        assert_eq!(filter.drive(1.0, f64::NAN, &SETTINGS), 1.0);
    }

    /// A stretch of keyframes that are alike.
    #[derive(Clone, Copy)]
    struct Stretch {
        n: usize,
        step_m: f64,
        turn_rad: f64,
        /// What the logarithm of the odometry's scale drifts by at each.
        drift: f64,
        /// How far the logarithm of the road's measurement is off at a keyframe; NaN where there is none.
        bias: fn(usize) -> f64,
        /// How far off the second source is, where there is one.
        second_bias: fn(usize) -> f64,
    }

    const STRAIGHT: Stretch =
        Stretch { n: 60, step_m: 1.5, turn_rad: 0.0, drift: 0.0, bias: |_| 0.0, second_bias: |_| 0.0 };

    /// The worst error of the logarithm of the scale in the last stretch, and the worst over its reported deviation.
    fn worst_in_last(stretches: &[Stretch], second: Option<ScaleSource>, settings: &ScaleFilterSettings) -> (f64, f64) {
        let mut filter = ScaleFilter::new(settings);
        let (mut log_scale, mut worst, mut sigmas) = (0.0, 0.0_f64, 0.0_f64);
        for (s, stretch) in stretches.iter().enumerate() {
            for i in 0..stretch.n {
                log_scale += stretch.drift + libm::log(filter.drive(stretch.step_m, stretch.turn_rad, settings));
                let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
                let others = second.map(|source| (source, (stretch.second_bias)(i) - sign * settings.sigma_of(source)));
                let road = (ScaleSource::GroundPlane, (stretch.bias)(i) + sign * 0.03);
                for (source, off) in others.into_iter().chain([road]) {
                    let measured = ScaleMeasurement { ratio: libm::exp(off - log_scale), relative_sigma: 0.02, source };
                    if let ScaleUpdate::Accept { correction, .. } = filter.update(&measured, settings) {
                        log_scale += libm::log(correction);
                    }
                }
                if s + 1 == stretches.len() {
                    worst = worst.max(log_scale.abs());
                    sigmas = sigmas.max(log_scale.abs() / filter.sigma());
                }
            }
        }
        (worst, sigmas)
    }

    #[test]
    fn no_disturbance_pulls_the_scale_away() {
        let settings = crate::tracking::TrackingSettings::STANDARD.scale;
        // As on KITTI 05: 16 % in a corner of 75 degrees, when nothing corrects it.
        let turn = Stretch { n: 26, step_m: 0.36, turn_rad: 0.05, drift: 0.006, ..STRAIGHT };
        let crest = Stretch { n: 13, bias: |_| 0.1, ..STRAIGHT };
        let truck = Stretch { n: 33, drift: 0.0003 * 1.5, bias: |_| f64::NAN, ..STRAIGHT };
        let parked = Stretch { n: 100, bias: |i| if i % 5 < 2 { -0.22 } else { 0.0 }, ..STRAIGHT };
        let wall = Stretch { n: 13, bias: |_| -0.22, ..STRAIGHT };
        let riding = Stretch { n: 13, bias: |_| 0.4, ..STRAIGHT };
        let worn = Stretch { n: 100, second_bias: |_| 0.015, ..STRAIGHT };
        let broken = Stretch { n: 13, second_bias: |_| -0.6, ..STRAIGHT };
        let first = Stretch { n: 1, step_m: 0.25, bias: |_| 0.5, ..STRAIGHT };
        let creeping = Stretch { n: 20, step_m: 0.25, ..STRAIGHT };
        // Limits with the road alone, with a network's depths and with wheels beside it.
        let check = |what: &str, stretches: &[Stretch], limits: [f64; 3]| {
            let seconds = [None, Some(ScaleSource::DepthNetwork), Some(ScaleSource::WheelSpeed)];
            for (second, limit) in seconds.into_iter().zip(limits) {
                let (worst, sigmas) = worst_in_last(stretches, second, &settings);
                assert!(worst < limit, "{what}, {second:?}: {worst}");
                assert!(sigmas < 3.0, "{what}, {second:?}: {sigmas} deviations");
            }
        };
        check("a turn in which landmarks change", &[STRAIGHT, turn], [0.085, 0.07, 0.03]);
        check("a crest", &[STRAIGHT, crest], [0.06, 0.045, 0.015]);
        check("a truck that hides the road", &[STRAIGHT, truck], [0.02, 0.02, 0.01]);
        check("parked cars", &[STRAIGHT, parked], [0.08, 0.04, 0.01]);
        check("a wall of parked cars", &[STRAIGHT, wall], [0.085, 0.01, 0.005]);
        check("a car ahead taken for road", &[STRAIGHT, riding], [0.06, 0.01, 0.005]);
        check("worn tyres", &[STRAIGHT, worn], [0.01, 0.01, 0.02]);
        check("a second source that breaks", &[STRAIGHT, broken], [0.01, 0.01, 0.01]);
        check("a start that was measured wrong", &[first, creeping, creeping], [0.02, 0.01, 0.01]);
        let deaf = ScaleFilterSettings { turn_drift_per_sqrt_rad: 0.0, ..settings };
        assert!(worst_in_last(&[STRAIGHT, turn], None, &deaf).0 > 0.085, "the turn is no test");
        let ungated = ScaleFilterSettings { gate_sigmas: f64::INFINITY, ..settings };
        let pulled = |settings: &ScaleFilterSettings| {
            worst_in_last(&[STRAIGHT, riding], Some(ScaleSource::DepthNetwork), settings).0
        };
        assert!(pulled(&ungated) > 0.02, "the gate is no test");
    }
}
