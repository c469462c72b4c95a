//! Improves rotation and direction of a step over all matches.

use super::damped::Descent;
use super::{Match, RelativePose, Stop, essential_of};
use crate::math::se3::skew;
use nalgebra::{Matrix3, Matrix5, Matrix6, Matrix6x5, Unit, UnitQuaternion, Vector3, Vector5, Vector6};

/// A motion with what the iteration knows about it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativeRefinement {
    /// The improved motion.
    pub second_from_first: RelativePose,
    /// Robust cost, in squared units of the plane z = 1.
    pub cost: f64,
    /// Why it stopped.
    pub stop: Stop,
}

const FIRST_DAMPING: f64 = 1e-3;

/// Increment `[omega, a, b]`: `exp(omega) R`, and the direction turned by `a`, `b` along its tangent plane.
fn moved(from: &RelativePose, tangents: &[Vector3<f64>; 2], step: &Vector5<f64>) -> RelativePose {
    let omega = Vector3::new(step[0], step[1], step[2]);
    RelativePose {
        rotation: UnitQuaternion::from_scaled_axis(omega) * from.rotation,
        direction: (from.direction + tangents[0] * step[3] + tangents[1] * step[4]).normalize(),
    }
}

/// Two unit vectors orthogonal to the direction and to each other.
fn tangent_plane(direction: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let smallest = direction.iamin();
    let mut axis = Vector3::zeros();
    axis[smallest] = 1.0;
    let first = Unit::new_normalize(direction.cross(&axis)).into_inner();
    [first, direction.cross(&first)]
}

/// Derivatives of the essential matrix by the five increments.
fn essential_derivatives(at: &RelativePose, tangents: &[Vector3<f64>; 2]) -> [Matrix3<f64>; 5] {
    let rotation = *at.rotation.to_rotation_matrix().matrix();
    let t = skew(&at.direction);
    [
        t * skew(&Vector3::x()) * rotation,
        t * skew(&Vector3::y()) * rotation,
        t * skew(&Vector3::z()) * rotation,
        skew(&tangents[0]) * rotation,
        skew(&tangents[1]) * rotation,
    ]
}

/// Sampson distance of one match and its derivatives by the five increments.
fn residual(e: &Matrix3<f64>, de: &[Matrix3<f64>; 5], m: &Match) -> Option<(f64, Vector5<f64>)> {
    let first = Vector3::new(m.first_z1.x, m.first_z1.y, 1.0);
    let second = Vector3::new(m.second_z1.x, m.second_z1.y, 1.0);
    let (line2, line1) = (e * first, e.tr_mul(&second));
    let gradient2 = line2.xy().norm_squared() + line1.xy().norm_squared();
    if gradient2 <= 0.0 {
        return None;
    }
    let inverse = 1.0 / libm::sqrt(gradient2);
    let distance = second.dot(&line2) * inverse;
    // By the entries of E: second first^T / |gradient| - distance (line2 first^T + second line1^T) / |gradient|^2,
    // the lines without their third entries.
    let share = distance * inverse * inverse;
    let left = second * inverse - Vector3::new(line2.x, line2.y, 0.0) * share;
    let right = Vector3::new(line1.x, line1.y, 0.0) * -share;
    let by_entry = left * first.transpose() + second * right.transpose();
    Some((distance, Vector5::from_fn(|k, _| de[k].dot(&by_entry))))
}

/// Cauchy's kernel: cost and weight of a squared residual.
pub(super) fn cauchy(residual2: f64, width2: f64) -> (f64, f64) {
    let ratio = residual2 / width2;
    (width2 * libm::log1p(ratio), 1.0 / (1.0 + ratio))
}

fn robust_cost<'m>(at: &RelativePose, matches: impl Iterator<Item = &'m Match>, width2: f64, cutoff2: f64) -> f64 {
    let e = essential_of(at);
    let ceiling = cauchy(cutoff2, width2).0;
    matches
        .map(|m| {
            let r = super::sampson_distance(&e, m);
            if r * r < cutoff2 { cauchy(r * r, width2).0 } else { ceiling }
        })
        .sum()
}

/// Minimises the robust Sampson error over rotation and direction.
///
/// Minimises  sum_i rho(sampson_i^2)  with rho = Cauchy, constant beyond `cutoff_z1`, by Levenberg-Marquardt.
///
/// # Inputs
/// * `matches`: outliers allowed, they are cut off.
/// * `start`: within the basin, e.g. from a minimal solver.
/// * `width_z1`: scale of the kernel, about the noise of a match on the plane z = 1.
/// * `cutoff_z1`: distance beyond which a match has no influence.
///
/// # Output
/// The refined motion; `start` itself when nothing improves it.
///
/// # Cost
/// O(n * `max_iterations`); 1.5 KiB of stack.
///
/// # Source
/// Hartley & Zisserman 2004, sec. 11.4.3 and app. A6.2. Own implementation.
pub fn refine_relative(
    matches: &[Match],
    start: &RelativePose,
    width_z1: f64,
    cutoff_z1: f64,
    max_iterations: usize,
) -> RelativeRefinement {
    refine_over(matches.iter(), start, width_z1, cutoff_z1, max_iterations)
}

/// [`refine_relative`] over matches that need not lie side by side.
pub(super) fn refine_over<'m>(
    matches: impl Iterator<Item = &'m Match> + Clone,
    start: &RelativePose,
    width_z1: f64,
    cutoff_z1: f64,
    max_iterations: usize,
) -> RelativeRefinement {
    let (width2, cutoff2) = (width_z1 * width_z1, cutoff_z1 * cutoff_z1);
    let (second_from_first, cost, stop) =
        RelativeProblem { matches, width2, cutoff2 }.descend(start, FIRST_DAMPING, max_iterations);
    RelativeRefinement { second_from_first, cost, stop }
}

struct RelativeProblem<I> {
    matches: I,
    width2: f64,
    cutoff2: f64,
}

impl<'m, I: Iterator<Item = &'m Match> + Clone> Descent<5> for RelativeProblem<I> {
    type State = RelativePose;

    fn cost(&self, at: &RelativePose) -> f64 {
        robust_cost(at, self.matches.clone(), self.width2, self.cutoff2)
    }

    fn normal_equations(&self, at: &RelativePose) -> (Matrix5<f64>, Vector5<f64>) {
        normal_equations(at, &tangent_plane(&at.direction), self.matches.clone(), self.width2, self.cutoff2)
    }

    fn moved(&self, from: &RelativePose, step: &Vector5<f64>) -> RelativePose {
        moved(from, &tangent_plane(&from.direction), step)
    }
}

/// Covariance of a step whose rotation and direction come from matches and whose length from elsewhere.
///
/// With t = length * direction the increments of the minimum map to the left increment `[omega, upsilon]` by
/// upsilon = length * (tangents * ab) + t x omega.
///
/// # Inputs
/// * `matches`, `at`, `cutoff_z1`: as for [`refine_relative`], at the minimum.
/// * `noise_z1`: standard deviation of a match's distance on the plane z = 1.
/// * `length_m`, `sigma_m`: length of the step and its standard deviation, m.
///
/// # Output
/// `[6, 6]` covariance of the left increment of `second_from_first` (rad, m); `None` when the matches do not
/// determine rotation and direction.
///
/// # Cost
/// O(n).
///
/// # Source
/// Hartley & Zisserman 2004, sec. 5.2.3 (backward transport of covariance). Own implementation.
pub fn relative_covariance(
    matches: &[Match],
    at: &RelativePose,
    noise_z1: f64,
    cutoff_z1: f64,
    length_m: f64,
    sigma_m: f64,
) -> Option<Matrix6<f64>> {
    let tangents = tangent_plane(&at.direction);
    let (information, _) = normal_equations(at, &tangents, matches.iter(), noise_z1 * noise_z1, cutoff_z1 * cutoff_z1);
    let covariance = information.cholesky()?.inverse() * (noise_z1 * noise_z1);
    let mut by_increments = Matrix6x5::zeros();
    by_increments.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
    by_increments.fixed_view_mut::<3, 3>(3, 0).copy_from(&(skew(&at.direction) * length_m));
    for (k, tangent) in tangents.iter().enumerate() {
        by_increments.fixed_view_mut::<3, 1>(3, 3 + k).copy_from(&(tangent * length_m));
    }
    let along = at.direction * sigma_m;
    let along = Vector6::new(0.0, 0.0, 0.0, along.x, along.y, along.z);
    let found = by_increments * covariance * by_increments.transpose() + along * along.transpose();
    found.iter().all(|v| v.is_finite()).then_some(found)
}

fn normal_equations<'m>(
    at: &RelativePose,
    tangents: &[Vector3<f64>; 2],
    matches: impl Iterator<Item = &'m Match>,
    width2: f64,
    cutoff2: f64,
) -> (Matrix5<f64>, Vector5<f64>) {
    let (e, de) = (essential_of(at), essential_derivatives(at, tangents));
    let (mut hessian, mut gradient) = (Matrix5::zeros(), Vector5::zeros());
    for m in matches {
        if let Some((r, jacobian)) = residual(&e, &de, m)
            && r * r < cutoff2
        {
            let weight = cauchy(r * r, width2).1;
            hessian.ger(weight, &jacobian, &jacobian, 1.0);
            gradient.axpy(r * weight, &jacobian, 1.0);
        }
    }
    (hessian, gradient)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use std::vec::Vec;

    fn truth() -> RelativePose {
        RelativePose {
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.08, 0.02)),
            direction: Vector3::new(0.05, -0.02, -1.0).normalize(),
        }
    }

    fn scene(n: usize, noise_z1: f64) -> Vec<Match> {
        let (mut rng, truth) = (Rng::new(9, 0, 0), truth());
        let mut noise = |amount: f64| (rng.unit_f64() - 0.5) * amount;
        (0..n)
            .map(|_| {
                let z = 15.0 + noise(20.0);
                let p = Vector3::new(noise(1.2) * z, noise(0.6) * z, z);
                let q = truth.rotation * p + truth.direction;
                let mut m = Match { first_z1: (p / p.z).xy(), second_z1: (q / q.z).xy() };
                m.second_z1.x += noise(noise_z1);
                m.second_z1.y += noise(noise_z1);
                m
            })
            .collect()
    }

    #[test]
    fn derivatives_agree_with_differences() {
        let at = truth();
        let tangents = tangent_plane(&at.direction);
        let de = essential_derivatives(&at, &tangents);
        for m in scene(20, 0.02) {
            let (_, jacobian) = residual(&essential_of(&at), &de, &m).expect("regular");
            for k in 0..5 {
                let mut step = Vector5::zeros();
                step[k] = 1e-6;
                let plus = super::super::sampson_distance(&essential_of(&moved(&at, &tangents, &step)), &m);
                let minus = super::super::sampson_distance(&essential_of(&moved(&at, &tangents, &-step)), &m);
                let difference = (plus - minus) / 2e-6;
                assert!((difference - jacobian[k]).abs() < 1e-6, "{k}: {difference} {}", jacobian[k]);
            }
        }
    }

    #[test]
    fn a_disturbed_start_returns_to_the_truth_in_spite_of_outliers() {
        let mut matches = scene(200, 1e-4);
        for (i, m) in matches.iter_mut().enumerate() {
            if i % 5 == 0 {
                m.second_z1.y += 0.05;
            }
        }
        let tangents = tangent_plane(&truth().direction);
        let start = moved(&truth(), &tangents, &Vector5::new(0.002, -0.002, 0.002, 0.03, -0.03));
        let refined = refine_relative(&matches, &start, 1e-4, 0.02, 30).second_from_first;
        assert!(refined.rotation.angle_to(&truth().rotation) < 1e-4);
        assert!((refined.direction - truth().direction).norm() < 3e-3, "{}", refined.direction - truth().direction);
    }

    #[test]
    fn without_matches_the_start_comes_back() {
        let refined = refine_relative(&[], &truth(), 1e-3, 1e-2, 5);
        assert_eq!((refined.second_from_first, refined.stop), (truth(), Stop::Stalled));
    }
}
