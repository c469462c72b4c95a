//! How wrong the odometry may be by now.
//!
//! Every keyframe adds the error of its step, turned errors of before swing the way that follows, and a wrong scale
//! stretches all of it together; a frame adds its own step to its keyframe's error.

use super::frame_pose::FramePose;
use super::tracker::{MAX_COAST_S, MAX_TURN_S, Tracker};
use super::{FrameStatus, PoseModel};
use crate::conventions::TimestampNs;
use crate::math::se3::skew;
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Standard deviations of the definition of the world, rad and m: what is exact still needs an inverse.
const FLOOR: f64 = 1e-6;
/// Prior of a step that no image constrains, rad and m; keeps the information of few matches invertible.
const UNKNOWN_STEP: f64 = 10.0;
/// Distance of what a standing vehicle sees, m: turns the pixels that pass for standing into metres.
const STANDING_DEPTH_M: f64 = 10.0;
/// A step's variance over what its matches claim: the errors of one track repeat from frame to frame and those of
/// neighbours go together, while the claim takes all for independent. Measured on two simulated towns; on others, at
/// other speeds and on another kind of way, the normalised error is 0.7 to 1.5 times that of the chi-square distribution
/// (tests/tests/odometry_covariance.rs, with the figures).
pub(super) const CLAIM_FACTOR: f64 = 3.0;
/// How far the speed of the last believed step may be off, m/s and rad/s; ours, from single steps on KITTI.
const SPEED_SIGMAS: [f64; 2] = [0.5, 0.03];
/// How a driver may accelerate and steer while nobody looks, m/s^2 and rad/s^2: half of hard braking and steering.
const DRIVER_SIGMAS: [f64; 2] = [4.0, 0.5];
/// Longest blindness that still makes a difference, s.
const MAX_BLIND_S: f64 = 3600.0;

/// Covariance of a pose's error and of what that has in common with the error of the scale.
///
/// The error is `[theta, p]` along the axes of the world (rad, m): the true rotation is `exp(theta) R`, the true
/// position lies `p` further.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Drift {
    pose: Matrix6<f64>,
    with_scale: Vector6<f64>,
    with_rate: Vector6<f64>,
}

/// What the scale filter says about the logarithm of the scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ScaleDoubt {
    /// Its variance.
    pub(super) variance: f64,
    /// Its covariance with the drift per metre, 1/m.
    pub(super) with_rate: f64,
}

impl Drift {
    /// No error at all: the definition of the world.
    pub(super) fn none() -> Self {
        Self { pose: Matrix6::zeros(), with_scale: Vector6::zeros(), with_rate: Vector6::zeros() }
    }

    /// Covariance of the pose, positive definite.
    pub(super) fn covariance(&self) -> Matrix6<f64> {
        0.5 * (self.pose + self.pose.transpose()) + Matrix6::identity() * (FLOOR * FLOOR)
    }

    /// The scale drifts over a distance driven.
    pub(super) fn drive(&mut self, distance_m: f64) {
        if distance_m.is_finite() {
            self.with_scale += self.with_rate * distance_m;
        }
    }

    /// The scale is corrected with these Kalman gains of itself and of its drift.
    pub(super) fn correct_scale(&mut self, gains: [f64; 2]) {
        self.with_rate -= self.with_scale * gains[1];
        self.with_scale *= 1.0 - gains[0];
    }

    /// A new window has a scale of its own.
    pub(super) fn forget_scale(&mut self) {
        (self.with_scale, self.with_rate) = (Vector6::zeros(), Vector6::zeros());
    }

    /// The error one step further: p' = p + theta x step + step * (error of the scale's logarithm).
    pub(super) fn moved(&self, step_in_world_m: &Vector3<f64>, scale: &ScaleDoubt) -> Self {
        let mut swing = Matrix6::identity();
        swing.fixed_view_mut::<3, 3>(3, 0).copy_from(&-skew(step_in_world_m));
        let mut stretch = Vector6::zeros();
        stretch.fixed_rows_mut::<3>(3).copy_from(step_in_world_m);
        let with_scale = swing * self.with_scale;
        let mixed = with_scale * stretch.transpose();
        let pose = swing * self.pose * swing.transpose() + mixed + mixed.transpose();
        Self {
            pose: pose + stretch * stretch.transpose() * scale.variance,
            with_scale: with_scale + stretch * scale.variance,
            with_rate: swing * self.with_rate + stretch * scale.with_rate,
        }
    }

    /// With an independent error added whose axes are those of a camera that is turned by `world_from_camera`.
    fn disturbed(mut self, world_from_camera: &Matrix3<f64>, covariance_in_camera: &Matrix6<f64>) -> Self {
        let mut turn = Matrix6::zeros();
        turn.fixed_view_mut::<3, 3>(0, 0).copy_from(world_from_camera);
        turn.fixed_view_mut::<3, 3>(3, 3).copy_from(world_from_camera);
        self.pose += turn * covariance_in_camera * turn.transpose();
        self
    }

    /// Without sight for a while, of which the prediction covers a part of the way and a part of the turn.
    fn blind(mut self, passed_s: f64, covered_s: [f64; 2], speed_m_per_s: f64, turn_rad_per_s: f64) -> Self {
        let passed_s = passed_s.clamp(0.0, MAX_BLIND_S);
        let missed_s = covered_s.map(|covered_s| (passed_s - covered_s).max(0.0));
        let [position, rotation] = coasted_variances(passed_s);
        let (missed_m, missed_rad) = (speed_m_per_s * missed_s[0], turn_rad_per_s * missed_s[1]);
        self.pose += diagonal(rotation + missed_rad * missed_rad, position + missed_m * missed_m);
        self
    }
}

/// How far constant velocity may be off after a while, m^2 and rad^2.
fn coasted_variances(passed_s: f64) -> [f64; 2] {
    [0, 1].map(|k: usize| {
        let (coasted, driven) = (SPEED_SIGMAS[k] * passed_s, 0.5 * DRIVER_SIGMAS[k] * passed_s * passed_s);
        coasted * coasted + driven * driven
    })
}

/// Information of the left increment against the prediction by constant velocity (rad, m).
pub(super) fn coasting_information(passed_s: f64) -> Matrix6<f64> {
    let [position, rotation] = coasted_variances(passed_s);
    diagonal(1.0 / rotation, 1.0 / position)
}

/// Covariance of a left increment from its information, with the weakest of priors.
pub(super) fn step_covariance(information: &Matrix6<f64>) -> Matrix6<f64> {
    let prior = Matrix6::identity() / (UNKNOWN_STEP * UNKNOWN_STEP);
    (information + prior).cholesky().map_or(diagonal(UNKNOWN_STEP, UNKNOWN_STEP), |c| c.inverse())
}

fn diagonal(rotation: f64, position: f64) -> Matrix6<f64> {
    Matrix6::from_diagonal(&Vector6::new(rotation, rotation, rotation, position, position, position))
}

impl Tracker<'_> {
    /// Covariance of a vehicle's step that passes for standing, camera axes.
    pub(super) fn standing_covariance(&self) -> Matrix6<f64> {
        let sigma_rad = self.settings.standing_flow_px / self.camera.fx;
        let sigma_m = sigma_rad * STANDING_DEPTH_M;
        diagonal(sigma_rad * sigma_rad, sigma_m * sigma_m)
    }

    /// What is known about the scale of the window.
    fn scale_doubt(&self) -> ScaleDoubt {
        if self.scale.n_measurements() > 0 {
            return ScaleDoubt { variance: self.scale.variance(), with_rate: self.scale.covariance_with_rate() };
        }
        // The filter knows nothing yet, but the first step was measured against the road.
        let (early, later) = (self.settings.scale.early_sigma, self.settings.scale.measurement_sigma);
        ScaleDoubt { variance: early * early + later * later, with_rate: 0.0 }
    }

    /// Notes the error of a believed pose; a keyframe's is what later frames add to.
    pub(super) fn note_drift(&mut self, pose: &FramePose) {
        let world_from_camera = pose.camera_from_world.inverse();
        let keyframe_in_world = self.newest.camera_from_world.inverse().translation.vector;
        let step_in_world_m = world_from_camera.translation.vector - keyframe_in_world;
        let moved = self.drift_at_keyframe.moved(&step_in_world_m, &self.scale_doubt());
        let turn = world_from_camera.rotation.to_rotation_matrix();
        self.drift = moved.disturbed(turn.matrix(), &(pose.step_covariance * CLAIM_FACTOR));
    }

    /// The error of a pose that no image confirms.
    pub(super) fn blind_drift(&self, pose: &FramePose, timestamp_ns: TimestampNs) -> Drift {
        if self.window.next_ordinal() == 0 {
            return Drift::none();
        }
        let velocity = &self.motion.velocity;
        let passed_s = self.seconds_since_last(timestamp_ns);
        let is_coasting = pose.status == FrameStatus::Doubtful && pose.model == PoseModel::Predicted;
        let covered_s = [MAX_COAST_S, MAX_TURN_S].map(|most_s| if is_coasting { passed_s.min(most_s) } else { 0.0 });
        let step_in_world_m = pose.camera_from_world.inverse().translation.vector
            - self.motion.camera_from_world.inverse().translation.vector;
        let moved = self.drift.moved(&step_in_world_m, &self.scale_doubt());
        let [turn, speed] = [0, 3].map(|first| velocity.fixed_rows::<3>(first).norm());
        moved.blind(passed_s, covered_s, speed, turn)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conventions::Rigid;
    use crate::math::{Rng, se3};
    use nalgebra::UnitQuaternion;

    /// The error of a pose as [`Drift`] defines it.
    fn error(estimated: &Rigid, truth: &Rigid) -> Vector6<f64> {
        let theta = (truth.rotation * estimated.rotation.inverse()).scaled_axis();
        let p = truth.translation.vector - estimated.translation.vector;
        Vector6::new(theta.x, theta.y, theta.z, p.x, p.y, p.z)
    }

    fn normal(rng: &mut Rng) -> f64 {
        // Irwin & Hall: the sum of twelve has variance 1.
        (0..12).map(|_| rng.unit_f64()).sum::<f64>() - 6.0
    }

    /// Drives a bend with random errors of known size many times over and compares the spread of the ends with what
    /// is claimed.
    #[test]
    fn the_claimed_covariance_is_that_of_many_drives() {
        const N_DRIVES: usize = 4000;
        const N_STEPS: usize = 12;
        let sigmas = Vector6::new(0.002, 0.004, 0.001, 0.01, 0.005, 0.03);
        let scale = ScaleDoubt { variance: 0.02 * 0.02, with_rate: 0.0 };
        let later_from_earlier = se3::exp(&Vector6::new(0.0, -0.08, 0.0, 0.0, 0.0, -1.5));
        let step_covariance = Matrix6::from_diagonal(&sigmas.component_mul(&sigmas));
        let (mut drift, mut camera_from_world) = (Drift::none(), Rigid::identity());
        for _ in 0..N_STEPS {
            let before = camera_from_world.inverse();
            camera_from_world = later_from_earlier * camera_from_world;
            let after = camera_from_world.inverse();
            let step_m = after.translation.vector - before.translation.vector;
            let turn = after.rotation.to_rotation_matrix();
            drift = drift.moved(&step_m, &scale).disturbed(turn.matrix(), &step_covariance);
        }
        let mut rng = Rng::new(5, 0, 0);
        let mut spread = Matrix6::zeros();
        for _ in 0..N_DRIVES {
            let stretch = libm::exp(0.02 * normal(&mut rng));
            let mut truth = Rigid::identity();
            for _ in 0..N_STEPS {
                let noise = sigmas.map(|sigma| sigma * normal(&mut rng));
                let mut step = later_from_earlier;
                step.translation.vector *= stretch;
                truth = se3::exp(&noise) * step * truth;
            }
            let e = error(&camera_from_world.inverse(), &truth.inverse());
            spread += e * e.transpose() / N_DRIVES as f64;
        }
        let whitened = drift.covariance().cholesky().expect("positive definite").inverse() * spread;
        assert!((whitened.trace() / 6.0 - 1.0).abs() < 0.05, "{whitened}");
        for k in 0..6 {
            let ratio = spread[(k, k)] / drift.covariance()[(k, k)];
            assert!((ratio - 1.0).abs() < 0.1, "{k}: {ratio}");
        }
    }

    #[test]
    fn a_corrected_scale_stops_stretching() {
        let scale = ScaleDoubt { variance: 0.01, with_rate: 0.0 };
        let step_m = Vector3::z() * 10.0;
        let mut drift = Drift::none().moved(&step_m, &scale);
        let certain = ScaleDoubt { variance: 0.0, with_rate: 0.0 };
        assert!((drift.moved(&step_m, &scale).covariance()[(5, 5)] - 4.0).abs() < 1e-9, "the same error twice");
        drift.correct_scale([1.0, 0.0]);
        assert!((drift.moved(&step_m, &certain).covariance()[(5, 5)] - 1.0).abs() < 1e-9, "no error any more");
    }

    #[test]
    fn blindness_grows_with_time_and_with_what_was_not_predicted() {
        let of = |passed_s: f64, covered_s: f64| Drift::none().blind(passed_s, [covered_s; 2], 10.0, 0.1).covariance();
        assert!(of(0.2, 0.2)[(3, 3)] > of(0.1, 0.1)[(3, 3)]);
        assert!(of(0.2, 0.0)[(5, 5)] > 4.0 && of(0.2, 0.2)[(5, 5)] < 0.1);
        assert!(of(f64::INFINITY, 1.0).iter().all(|v| v.is_finite()));
        assert!(step_covariance(&Matrix6::zeros()).cholesky().is_some(), "no match at all");
        let turned = UnitQuaternion::from_scaled_axis(Vector3::y() * core::f64::consts::FRAC_PI_2);
        let sideways = Drift::none().disturbed(turned.to_rotation_matrix().matrix(), &diagonal(0.0, 0.0));
        assert!(sideways.covariance().cholesky().is_some(), "the floor");
    }
}
