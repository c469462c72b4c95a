//! Improves a camera pose over landmarks with known inverse depth.

use super::Stop;
use super::damped::Descent;
use crate::conventions::Rigid;
use crate::math::se3;
use nalgebra::{Matrix2x6, Matrix6, Vector2, Vector3, Vector6};

/// A landmark of a reference camera and where the camera to be placed sees it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LandmarkMatch {
    /// Its ray in the reference camera, on the plane z = 1.
    pub reference_z1: Vector2<f64>,
    /// One over its depth along the reference camera's axis, 1/m; 0 is infinitely far and still carries rotation.
    pub inverse_depth: f64,
    /// Standard deviation of that inverse depth, 1/m.
    pub inverse_depth_sigma: f64,
    /// Where the camera sees it, on the plane z = 1.
    pub seen_z1: Vector2<f64>,
}

/// A pose with the evidence for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseRefinement {
    /// The improved pose.
    pub camera_from_reference: Rigid,
    /// Information matrix of the left increment `[omega, upsilon]` (rad, m), of matches within the cutoff.
    pub information: Matrix6<f64>,
    /// Matches within the cutoff.
    pub n_inliers: usize,
    /// Robust cost: squared errors in units of their standard deviation.
    pub cost: f64,
    /// Why it stopped.
    pub stop: Stop,
}

/// Width of the Cauchy kernel in standard deviations (95 % efficiency on Gaussian noise, Rey 1983).
const KERNEL_SIGMAS: f64 = 2.3849;
const FIRST_DAMPING: f64 = 1e-4;

impl LandmarkMatch {
    /// The landmark in the camera, scaled by the inverse depth; `None` behind it.
    fn in_camera(&self, camera_from_reference: &Rigid) -> Option<Vector3<f64>> {
        let ray = Vector3::new(self.reference_z1.x, self.reference_z1.y, 1.0);
        let q = camera_from_reference.rotation * ray + camera_from_reference.translation.vector * self.inverse_depth;
        (q.z > 0.0).then_some(q)
    }

    /// Squared reprojection error in units of its variance (measurement plus the effect of the depth's
    /// uncertainty along the epipolar line); infinite behind the camera.
    pub fn squared_sigmas(&self, camera_from_reference: &Rigid, noise_z1: f64) -> f64 {
        self.predict(camera_from_reference, noise_z1).map_or(f64::INFINITY, |p| p.whiten(p.residual).norm_squared())
    }

    fn predict(&self, camera_from_reference: &Rigid, noise_z1: f64) -> Option<Prediction> {
        let q = self.in_camera(camera_from_reference)?;
        let inverse_z = 1.0 / q.z;
        let predicted = q.xy() * inverse_z;
        let t = camera_from_reference.translation.vector;
        // Moves along this line when the inverse depth changes by one standard deviation.
        let along = (t.xy() - predicted * t.z) * (inverse_z * self.inverse_depth_sigma);
        let spread = along.norm();
        // Covariance noise^2 I + along along^T, so its inverse square root shrinks the part along the line only.
        let shrink = noise_z1 / libm::sqrt(noise_z1 * noise_z1 + spread * spread) - 1.0;
        let axis = if spread > 0.0 { along / spread } else { Vector2::zeros() };
        Some(Prediction { predicted, residual: predicted - self.seen_z1, inverse_z, axis, shrink, noise_z1 })
    }

    /// Whitened residual and its derivative by the left increment.
    fn whitened(&self, camera_from_reference: &Rigid, noise_z1: f64) -> Option<(Vector2<f64>, Matrix2x6<f64>)> {
        let prediction = self.predict(camera_from_reference, noise_z1)?;
        let (x, y) = (prediction.predicted.x, prediction.predicted.y);
        let w = self.inverse_depth * prediction.inverse_z;
        let columns = [
            Vector2::new(-x * y, -(1.0 + y * y)),
            Vector2::new(1.0 + x * x, x * y),
            Vector2::new(-y, x),
            Vector2::new(w, 0.0),
            Vector2::new(0.0, w),
            Vector2::new(-x * w, -y * w),
        ];
        let derivative = Matrix2x6::from_columns(&columns.map(|column| prediction.whiten(column)));
        Some((prediction.whiten(prediction.residual), derivative))
    }
}

/// Where a landmark should be seen, on the plane z = 1, and how far off it may be.
struct Prediction {
    predicted: Vector2<f64>,
    residual: Vector2<f64>,
    inverse_z: f64,
    /// The epipolar line, along which the depth's uncertainty spreads it.
    axis: Vector2<f64>,
    /// What is added to 1 along that line to whiten.
    shrink: f64,
    noise_z1: f64,
}

impl Prediction {
    #[inline]
    fn whiten(&self, v: Vector2<f64>) -> Vector2<f64> {
        (v + self.axis * (self.shrink * self.axis.dot(&v))) / self.noise_z1
    }
}

fn robust_cost(pose: &Rigid, matches: &[LandmarkMatch], noise_z1: f64, cutoff2: f64) -> f64 {
    let width2 = KERNEL_SIGMAS * KERNEL_SIGMAS;
    let rho = |s2: f64| width2 * libm::log1p(s2.min(cutoff2) / width2);
    matches.iter().map(|m| rho(m.squared_sigmas(pose, noise_z1))).sum()
}

/// Estimates the camera pose from landmarks by minimising their robust reprojection error.
///
/// Minimises  sum_i rho(|| z_i - pi(T p_i) ||^2_{Sigma_i})  over T = camera_from_reference, with rho = Cauchy,
/// constant beyond `cutoff_sigmas`; Sigma_i holds the landmark's own uncertainty, so that far points steer the
/// rotation and barely known depths do not steer the translation.
///
/// # Inputs
/// * `matches`: those behind the camera count as outliers.
/// * `predicted_camera_from_reference`: where the iteration starts.
/// * `noise_z1`: standard deviation of a sighting on the plane z = 1, per axis.
/// * `cutoff_sigmas`: distance beyond which a match has no influence.
/// * `prior_information`: of the left increment against the prediction (rad, m); zero for none.
///
/// # Output
/// The pose, its information, the inlier count and why it stopped. With too few matches the information is
/// singular and the prediction comes back, `Stalled`.
///
/// # Cost
/// O(n * `max_iterations`); 2 KiB of stack.
///
/// # Source
/// Hartley & Zisserman 2004, app. A6.2; Madsen, Nielsen & Tingleff 2004, sec. 3.2. Own implementation.
pub fn refine_pose(
    matches: &[LandmarkMatch],
    predicted_camera_from_reference: &Rigid,
    noise_z1: f64,
    cutoff_sigmas: f64,
    prior_information: &Matrix6<f64>,
    max_iterations: usize,
) -> PoseRefinement {
    let cutoff2 = cutoff_sigmas * cutoff_sigmas;
    let problem = PoseProblem {
        matches,
        reference_from_predicted: predicted_camera_from_reference.inverse(),
        noise_z1,
        cutoff2,
        prior_information,
    };
    let (best, cost, stop) = problem.descend(predicted_camera_from_reference, FIRST_DAMPING, max_iterations);
    let (information, _, n_inliers) = normal_equations(&best, matches, noise_z1, cutoff2);
    PoseRefinement { camera_from_reference: best, information, n_inliers, cost, stop }
}

struct PoseProblem<'m> {
    matches: &'m [LandmarkMatch],
    reference_from_predicted: Rigid,
    noise_z1: f64,
    cutoff2: f64,
    prior_information: &'m Matrix6<f64>,
}

impl PoseProblem<'_> {
    /// Increment from the prediction to a pose.
    fn off(&self, pose: &Rigid) -> Vector6<f64> {
        se3::log(&(pose * self.reference_from_predicted))
    }
}

impl Descent<6> for PoseProblem<'_> {
    type State = Rigid;

    fn cost(&self, at: &Rigid) -> f64 {
        let off = self.off(at);
        robust_cost(at, self.matches, self.noise_z1, self.cutoff2) + off.dot(&(self.prior_information * off))
    }

    fn normal_equations(&self, at: &Rigid) -> (Matrix6<f64>, Vector6<f64>) {
        let (hessian, gradient, _) = normal_equations(at, self.matches, self.noise_z1, self.cutoff2);
        (hessian + self.prior_information, gradient + self.prior_information * self.off(at))
    }

    fn moved(&self, from: &Rigid, step: &Vector6<f64>) -> Rigid {
        se3::exp(step) * from
    }
}

fn normal_equations(
    pose: &Rigid,
    matches: &[LandmarkMatch],
    noise_z1: f64,
    cutoff2: f64,
) -> (Matrix6<f64>, Vector6<f64>, usize) {
    let width2 = KERNEL_SIGMAS * KERNEL_SIGMAS;
    let (mut hessian, mut gradient, mut n_inliers) = (Matrix6::zeros(), Vector6::zeros(), 0);
    for m in matches {
        let Some((r, jacobian)) = m.whitened(pose, noise_z1) else { continue };
        let s2 = r.norm_squared();
        if s2 < cutoff2 {
            let weight = 1.0 / (1.0 + s2 / width2);
            hessian += jacobian.tr_mul(&jacobian) * weight;
            gradient += jacobian.tr_mul(&r) * weight;
            n_inliers += 1;
        }
    }
    (hessian, gradient, n_inliers)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::Point3;
    use std::vec::Vec;

    const NOISE_Z1: f64 = 1e-3;

    fn truth() -> Rigid {
        se3::exp(&Vector6::new(0.01, -0.06, 0.005, 0.1, -0.02, -1.2))
    }

    fn scene(n: usize) -> Vec<LandmarkMatch> {
        let mut rng = Rng::new(8, 0, 0);
        (0..n)
            .map(|i| {
                let z = 5.0 + 40.0 * rng.unit_f64();
                let p = Vector3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.5 * z, z);
                let q = truth() * Point3::from(p);
                let outlier = if i % 6 == 0 { 0.1 } else { 0.0 };
                LandmarkMatch {
                    reference_z1: (p / p.z).xy(),
                    inverse_depth: 1.0 / z,
                    inverse_depth_sigma: 0.05 / z,
                    seen_z1: (q.coords / q.z).xy() + Vector2::new(outlier, 0.5 * outlier),
                }
            })
            .collect()
    }

    #[test]
    fn derivatives_agree_with_differences() {
        // The whitening is frozen within a step, so compare with certain depths, where it does not change.
        for m in scene(10).into_iter().map(|m| LandmarkMatch { inverse_depth_sigma: 0.0, ..m }) {
            let (_, jacobian) = m.whitened(&truth(), NOISE_Z1).expect("in front");
            for k in 0..6 {
                let mut step = Vector6::zeros();
                step[k] = 1e-6;
                let at = |s: Vector6<f64>| m.whitened(&(se3::exp(&s) * truth()), NOISE_Z1).expect("in front").0;
                let difference = (at(step) - at(-step)) / 2e-6;
                let error = (difference - jacobian.column(k)).norm();
                assert!(error < 1e-4 * (1.0 + difference.norm()), "{k}: {error}");
            }
        }
    }

    #[test]
    fn a_disturbed_prediction_returns_to_the_truth() {
        let start = se3::exp(&Vector6::new(0.01, 0.01, -0.01, 0.3, 0.1, 0.3)) * truth();
        let refined = refine_pose(&scene(120), &start, NOISE_Z1, 30.0, &Matrix6::zeros(), 30);
        let error = se3::log(&(refined.camera_from_reference * truth().inverse()));
        assert!(error.norm() < 1e-3, "{error}");
        assert_eq!(refined.n_inliers, 100);
    }

    #[test]
    fn points_at_infinity_fix_the_rotation_only() {
        let far: Vec<_> = scene(60).into_iter().map(|m| LandmarkMatch { inverse_depth: 0.0, ..m }).collect();
        let refined = refine_pose(&far, &truth(), NOISE_Z1, 5.0, &Matrix6::zeros(), 5);
        assert!(refined.information[(0, 0)] > 0.0);
        assert_eq!(refined.information[(3, 3)], 0.0);
    }

    #[test]
    fn a_strong_prior_holds_the_prediction() {
        let start = se3::exp(&Vector6::new(0.0, 0.0, 0.0, 0.3, 0.0, 0.0)) * truth();
        let held = refine_pose(&scene(120), &start, NOISE_Z1, 30.0, &(Matrix6::identity() * 1e12), 10);
        assert!(se3::log(&(held.camera_from_reference * start.inverse())).norm() < 1e-3);
    }
}
