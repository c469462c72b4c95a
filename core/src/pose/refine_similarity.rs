//! Improves a similarity over matches with depths.

use super::damped::Descent;
use super::{PointMatch, Stop};
use crate::conventions::Similarity;
use crate::math::se3::skew;
use crate::math::sim3::{self, Matrix7, Tangent7};
use nalgebra::{Matrix3, SMatrix, Vector3};

type Matrix3x7 = SMatrix<f64, 3, 7>;

/// A similarity with the evidence for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimilarityRefinement {
    /// The improved similarity.
    pub second_from_first: Similarity,
    /// Information of its left increment `[omega, upsilon, sigma]`, of matches within the cutoff.
    pub information: Matrix7,
    /// Matches within the cutoff.
    pub n_inliers: usize,
    /// Robust cost: squared errors in units of their standard deviation.
    pub cost: f64,
    /// Why it stopped.
    pub stop: Stop,
}

impl SimilarityRefinement {
    /// Information of the right increment of `second_from_first`, which is what a loop of a pose graph takes.
    pub fn right_information(&self) -> Matrix7 {
        let left_from_right = sim3::adjoint(&self.second_from_first);
        left_from_right.transpose() * self.information * left_from_right
    }
}

/// Width of the Cauchy kernel in standard deviations (95 % efficiency on Gaussian noise, Rey 1983).
const KERNEL_SIGMAS: f64 = 2.3849;
const FIRST_DAMPING: f64 = 1e-4;

impl PointMatch {
    /// Squared error in units of its variance, 3 on average where only noise is wrong; infinite behind the second camera
    /// or without depths.
    pub fn squared_sigmas(&self, second_from_first: &Similarity, noise_z1: f64) -> f64 {
        let squared = self.whitened(second_from_first, noise_z1).map_or(f64::INFINITY, |(r, _)| r.norm_squared());
        if squared.is_nan() { f64::INFINITY } else { squared }
    }

    /// Whitened residual and its derivative by the left increment.
    ///
    /// The residual is where the first camera's point falls in the second image, against where it is seen, and the
    /// logarithm of its depth there against the second camera's. Noise: of both pixels and of both depths, and the first
    /// depth moves all three numbers together.
    fn whitened(&self, second_from_first: &Similarity, noise_z1: f64) -> Option<(Vector3<f64>, Matrix3x7)> {
        let (first, second) = (self.first.point()?, self.second.point()?);
        let rotated = second_from_first.isometry.rotation * first * second_from_first.scaling();
        let q = rotated + second_from_first.isometry.translation.vector;
        if q.z.is_nan() || q.z <= 0.0 {
            return None;
        }
        let (x, y, w) = (q.x / q.z, q.y / q.z, 1.0 / q.z);
        let residual = Vector3::new(x - self.second.seen_z1.x, y - self.second.seen_z1.y, libm::log(q.z / second.z));
        let by_q = Matrix3::new(w, 0.0, -x * w, 0.0, w, -y * w, 0.0, 0.0, w);
        // A depth that is larger by the factor exp(d) moves the point along its ray by d times its distance.
        let by_first_depth = by_q * rotated * self.first.log_depth_sigma();
        let second_depth = self.second.log_depth_sigma();
        let pixels2 = 2.0 * noise_z1 * noise_z1;
        let covariance = Matrix3::from_diagonal(&Vector3::new(pixels2, pixels2, second_depth * second_depth))
            + by_first_depth * by_first_depth.transpose();
        let mut jacobian = Matrix3x7::zeros();
        jacobian.fixed_view_mut::<3, 3>(0, 0).copy_from(&(by_q * -skew(&q)));
        jacobian.fixed_view_mut::<3, 3>(0, 3).copy_from(&by_q);
        jacobian.fixed_view_mut::<3, 1>(0, 6).copy_from(&(by_q * q));
        let lower = covariance.cholesky()?.l();
        Some((lower.solve_lower_triangular(&residual)?, lower.solve_lower_triangular(&jacobian)?))
    }
}

/// Estimates a similarity by minimising the robust error of reprojection and depth.
///
/// Minimises  sum_i rho(|| [z_i - pi(S p_i), ln d_i - ln (S p_i)_z] ||^2_{Sigma_i})  over S = `second_from_first`, with
/// rho = Cauchy, constant beyond `cutoff_sigmas`. The depths decide about the scale where both cameras stand at one place,
/// the reprojection where they do not.
///
/// # Inputs
/// * `matches`: those without depths or behind the camera count as outliers.
/// * `start`: where the iteration starts.
/// * `noise_z1`: standard deviation of a sighting on the plane z = 1, per axis, in both images.
/// * `cutoff_sigmas`: distance beyond which a match has no influence.
///
/// # Output
/// The similarity, its information, the inlier count and why it stopped. With too few matches the information is
/// singular and the start comes back, `Stalled`.
///
/// # Cost
/// O(n * `max_iterations`); 3 KiB of stack.
///
/// # Source
/// Hartley & Zisserman 2004, app. A6.2; Madsen, Nielsen & Tingleff 2004, sec. 3.2. Own implementation.
pub fn refine_similarity(
    matches: &[PointMatch],
    start: &Similarity,
    noise_z1: f64,
    cutoff_sigmas: f64,
    max_iterations: usize,
) -> SimilarityRefinement {
    let problem = SimilarityProblem { matches, noise_z1, cutoff2: cutoff_sigmas * cutoff_sigmas };
    let (best, cost, stop) = problem.descend(start, FIRST_DAMPING, max_iterations);
    let (information, _) = problem.normal_equations(&best);
    let n_inliers = matches.iter().filter(|m| m.squared_sigmas(&best, noise_z1) < problem.cutoff2).count();
    SimilarityRefinement { second_from_first: best, information, n_inliers, cost, stop }
}

struct SimilarityProblem<'m> {
    matches: &'m [PointMatch],
    noise_z1: f64,
    cutoff2: f64,
}

impl Descent<7> for SimilarityProblem<'_> {
    type State = Similarity;

    fn cost(&self, at: &Similarity) -> f64 {
        let width2 = KERNEL_SIGMAS * KERNEL_SIGMAS;
        let rho = |s2: f64| width2 * libm::log1p(s2.min(self.cutoff2) / width2);
        self.matches.iter().map(|m| rho(m.squared_sigmas(at, self.noise_z1))).sum()
    }

    fn normal_equations(&self, at: &Similarity) -> (Matrix7, Tangent7) {
        let (mut hessian, mut gradient) = (Matrix7::zeros(), Tangent7::zeros());
        for (r, jacobian) in self.matches.iter().filter_map(|m| m.whitened(at, self.noise_z1)) {
            let s2 = r.norm_squared();
            if s2 < self.cutoff2 {
                let weight = 1.0 / (1.0 + s2 / (KERNEL_SIGMAS * KERNEL_SIGMAS));
                hessian += jacobian.tr_mul(&jacobian) * weight;
                gradient += jacobian.tr_mul(&r) * weight;
            }
        }
        (hessian, gradient)
    }

    fn moved(&self, from: &Similarity, step: &Tangent7) -> Similarity {
        sim3::exp(step) * from
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::PointSighting;
    use nalgebra::Vector2;

    #[test]
    fn derivatives_agree_with_differences() {
        // The whitening is frozen within a step, so compare at the truth, where its change has no effect.
        let at = sim3::exp(&Tangent7::from([0.1, -0.5, 0.05, 1.0, -0.2, 2.0, 0.3]));
        for (x, y, z) in [(0.1, 0.2, 5.0), (-0.4, 0.1, 20.0), (0.3, -0.2, 60.0)] {
            let q = at * nalgebra::Point3::new(x * z, y * z, z);
            let sighting = |x: f64, y: f64, z: f64| PointSighting {
                seen_z1: Vector2::new(x, y),
                inverse_depth: 1.0 / z,
                inverse_depth_sigma: 0.05 / z,
            };
            let m = PointMatch { first: sighting(x, y, z), second: sighting(q.x / q.z, q.y / q.z, q.z) };
            let (r, jacobian) = m.whitened(&at, 1e-3).expect("in front");
            assert!(r.norm() < 1e-9);
            for k in 0..7 {
                let mut d = Tangent7::zeros();
                d[k] = 1e-6;
                let of = |d: Tangent7| m.whitened(&(sim3::exp(&d) * at), 1e-3).expect("in front").0;
                let off = (of(d) - of(-d)) / 2e-6 - jacobian.column(k);
                assert!(off.norm() < 1e-4 * jacobian.norm(), "{k}: {off}");
            }
        }
    }
}
