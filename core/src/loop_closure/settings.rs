//! What closing loops believes, and how much.

use crate::math::sim3::Matrix7;
use crate::places::{RecognizerSettings, VerificationSettings};
use crate::pose_graph::{Extent, Gauge, OptimizeSettings, information_of_sigmas};
use nalgebra::Matrix6;

/// Constants of the [`LoopCloser`](super::LoopCloser).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoopSettings {
    /// Which keyframes are candidates.
    pub recognizer: RecognizerSettings,
    /// Which candidates are loops.
    pub verification: VerificationSettings,
    /// How the graph is optimised.
    pub optimize: OptimizeSettings,
    /// Error of a measured loop that all its points have in common (shape of the window, calibration), which its information
    /// does not know: rotation, rad; translation, m; logarithm of the scale. Ours.
    pub common_sigmas: [f64; 3],
    /// A loop may cost this many standard deviations (of all its 7 numbers together) when odometry, the loops before and it
    /// agree as well as they can: more is a place that only looks the same. Range 4..20; 6 as in
    /// [`OptimizeSettings::max_loop_sigmas`].
    pub max_added_sigmas: f64,
    /// Keyframes between two loops: neighbours say the same. Range 1..50; bounds the work, and the edges that a street
    /// takes that is driven twice.
    pub min_keyframes_between: u32,
}

impl LoopSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        recognizer: RecognizerSettings::STANDARD,
        verification: VerificationSettings::STANDARD,
        optimize: OptimizeSettings {
            gauge: Gauge::First,
            extent: Extent::Whole,
            is_scale_free: true,
            max_loop_sigmas: 6.0,
            max_iterations: 30,
        },
        common_sigmas: [3e-3, 0.1, 0.01],
        max_added_sigmas: 6.0,
        min_keyframes_between: 3,
    };
}

/// What odometry loses on its way: a random walk in the length driven.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OdometryNoise {
    /// Rotation, rad per square root of a metre.
    pub rotation_rad: f64,
    /// Translation, m per square root of a metre.
    pub translation_m: f64,
    /// Logarithm of the scale, per square root of a metre: the scale is measured on the road all the time, so it creeps.
    pub log_scale: f64,
    /// A step counts as at least this long, m.
    pub min_step_m: f64,
}

/// A step on which tracking was lost is off by at least this: rotation, rad; translation, m. Ours: in a sharp turn that was
/// refused as one that no vehicle makes, the rotation was 0.7 rad off.
const LOST_SIGMAS: [f64; 2] = [0.5, 5.0];

impl OdometryNoise {
    /// Ours, and loose: 1.8 degrees, 0.6 m and 6 % of the scale in a kilometre, all three as random walks.
    pub const STANDARD: Self = Self { rotation_rad: 1e-3, translation_m: 0.02, log_scale: 2e-3, min_step_m: 0.1 };

    /// Information of the first step of a drive that begins nobody knows where in a known map.
    pub fn unknown_start() -> Matrix7 {
        information_of_sigmas(1e2, 1e6, 1.0)
    }

    /// Information of a step of this length, for [`KeyframePacket`](super::KeyframePacket).
    pub fn information(&self, step_m: f64) -> Matrix7 {
        let [rotation_rad, translation_m, log_scale] = self.sigmas(step_m);
        information_of_sigmas(rotation_rad, translation_m, log_scale)
    }

    /// Information of a step on which tracking was lost.
    ///
    /// # Inputs
    /// * `grown`: by how much the odometry's covariance grew on it, `[theta, p]` (rad, m).
    /// * `log_scale_sigma`: of the scale that the odometry has begun anew with.
    ///
    /// # Output
    /// The same in all directions, as large as in the worst.
    pub fn blind_information(&self, step_m: f64, grown: &Matrix6<f64>, log_scale_sigma: f64) -> Matrix7 {
        let [rotation_rad, translation_m, log_scale] = self.sigmas(step_m);
        // Written so that NaN, and a covariance that shrinks, leave what a step is off by anyway.
        let worst = |first: usize| (first..first + 3).map(|i| grown[(i, i)]).fold(0.0, f64::max);
        let with = |sigma: f64, variance: f64| libm::sqrt(sigma * sigma + variance);
        // A window that was given up had images that contradict what was predicted: the claim counts for little.
        let [least_rad2, least_m2] = LOST_SIGMAS.map(|sigma| sigma * sigma);
        let log_scale_variance = if log_scale_sigma.is_finite() { log_scale_sigma * log_scale_sigma } else { 1.0 };
        information_of_sigmas(
            with(rotation_rad, worst(0).max(least_rad2)),
            with(translation_m, worst(3).max(least_m2)),
            with(log_scale, log_scale_variance),
        )
    }

    /// Standard deviations of a step of this length: rotation, translation, logarithm of the scale.
    fn sigmas(&self, step_m: f64) -> [f64; 3] {
        let root = libm::sqrt(step_m.max(self.min_step_m));
        [self.rotation_rad, self.translation_m, self.log_scale].map(|sigma| sigma * root)
    }
}
