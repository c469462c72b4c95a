//! Merges uncertain measurements of the scale into one that drifts slowly.

/// How the odometry's own scale drifts, and what is an implausible measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleFilterSettings {
    /// Standard deviation of the natural logarithm of the scale before the first measurement. Range 0.1..3.
    pub first_sigma: f64,
    /// Drift of the logarithm per square root of a metre driven. Range 0.0001..0.05.
    pub drift_per_sqrt_m: f64,
    /// What a single road measurement can be wrong by beyond its pixels' noise (bumps, pitch). Range 0.005..0.3.
    pub measurement_sigma: f64,
    /// A measurement further off than this many standard deviations is rejected. Range 2..5.
    pub gate_sigmas: f64,
    /// After so many rejections in a row the filter doubts itself and opens up. Range 3..100.
    pub max_rejections: u32,
}

/// What became of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ScaleUpdate {
    /// The factor by which lengths are to be multiplied from now on.
    Accept {
        /// Multiplies all lengths.
        correction: f64,
    },
    /// The measurement jumps implausibly.
    Reject {
        /// Natural logarithm of the measured factor.
        log_ratio: f64,
        /// What was allowed.
        limit: f64,
    },
}

/// Kalman filter on the logarithm of (true length / length in the odometry's scale).
///
/// The caller applies each correction to its window, so the expected logarithm is always zero and only its
/// variance is kept.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScaleFilter {
    variance: f64,
    rejections: u32,
}

impl ScaleFilter {
    /// A filter that knows nothing.
    pub fn new(settings: &ScaleFilterSettings) -> Self {
        Self { variance: settings.first_sigma * settings.first_sigma, rejections: 0 }
    }

    /// Standard deviation of the logarithm of the scale.
    pub fn sigma(&self) -> f64 {
        libm::sqrt(self.variance)
    }

    /// Lets the scale drift over a distance driven.
    pub fn drive(&mut self, distance_m: f64, settings: &ScaleFilterSettings) {
        let ceiling = settings.first_sigma * settings.first_sigma;
        let drift = settings.drift_per_sqrt_m * settings.drift_per_sqrt_m * distance_m.max(0.0);
        if drift.is_finite() {
            self.variance = (self.variance + drift).min(ceiling);
        }
    }

    /// Merges one measurement of the factor (true length / length in the current scale).
    ///
    /// # Inputs
    /// * `measured_ratio`: above 0; anything else is rejected.
    /// * `pixel_sigma`: relative standard deviation that the measurement claims for itself.
    pub fn update(&mut self, measured_ratio: f64, pixel_sigma: f64, settings: &ScaleFilterSettings) -> ScaleUpdate {
        let log_ratio = libm::log(measured_ratio);
        let noise = settings.measurement_sigma * settings.measurement_sigma + pixel_sigma * pixel_sigma;
        let limit = settings.gate_sigmas * libm::sqrt(self.variance + noise);
        if log_ratio.is_nan() || noise.is_nan() || log_ratio.abs() > limit {
            self.rejections += 1;
            if self.rejections >= settings.max_rejections {
                self.variance = settings.first_sigma * settings.first_sigma;
                self.rejections = 0;
            }
            return ScaleUpdate::Reject { log_ratio, limit };
        }
        self.rejections = 0;
        let gain = self.variance / (self.variance + noise);
        self.variance *= 1.0 - gain;
        ScaleUpdate::Accept { correction: libm::exp(gain * log_ratio) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETTINGS: ScaleFilterSettings = ScaleFilterSettings {
        first_sigma: 1.0,
        drift_per_sqrt_m: 0.005,
        measurement_sigma: 0.03,
        gate_sigmas: 3.0,
        max_rejections: 5,
    };

    /// Feeds noisy measurements of a scale that is off by 0.7 and returns what remains.
    fn remaining_error(n: usize) -> f64 {
        let mut filter = ScaleFilter::new(&SETTINGS);
        let mut scale = 0.7;
        for i in 0..n {
            let noise = if i % 2 == 0 { 1.02 } else { 0.98 };
            filter.drive(1.0, &SETTINGS);
            if let ScaleUpdate::Accept { correction } = filter.update(noise / scale, 0.0, &SETTINGS) {
                scale *= correction;
            }
        }
        libm::fabs(libm::log(scale))
    }

    #[test]
    fn the_first_measurement_is_believed_and_later_ones_are_averaged() {
        assert!((remaining_error(1) - 0.02).abs() < 0.002);
        assert!(remaining_error(40) < 0.01);
    }

    #[test]
    fn a_jump_is_rejected_until_it_insists() {
        let mut filter = ScaleFilter::new(&SETTINGS);
        for _ in 0..20 {
            filter.update(1.0, 0.0, &SETTINGS);
        }
        for i in 0..5 {
            let update = filter.update(1.5, 0.0, &SETTINGS);
            assert!(matches!(update, ScaleUpdate::Reject { .. }), "{i}: {update:?}");
        }
        assert!(matches!(filter.update(1.5, 0.0, &SETTINGS), ScaleUpdate::Accept { .. }));
    }

    #[test]
    fn nonsense_is_rejected() {
        let mut filter = ScaleFilter::new(&SETTINGS);
        for ratio in [f64::NAN, 0.0, -1.0, f64::INFINITY] {
            assert!(matches!(filter.update(ratio, 0.0, &SETTINGS), ScaleUpdate::Reject { .. }), "{ratio}");
        }
        assert!(matches!(filter.update(1.0, f64::NAN, &SETTINGS), ScaleUpdate::Reject { .. }));
    }
}
