//! The length of a step whose rotation and direction are known.

use super::{LandmarkMatch, RelativePose};
use nalgebra::Vector3;

/// A length with its doubt.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepLength {
    /// The length, m, at least 0.
    pub length_m: f64,
    /// Its standard deviation, m.
    pub sigma_m: f64,
}

const MAX_STEPS: usize = 20;
/// Width of the Cauchy kernel in standard deviations (95 % efficiency on Gaussian noise, Rey 1983).
const KERNEL_SIGMAS: f64 = 2.3849;
/// A relative change below this is negligible.
const NEGLIGIBLE_RATIO: f64 = 1e-6;

/// Fits the length of a step to landmarks, robustly.
///
/// Minimises  sum_i rho(|| z_i - pi(R x_i + s d / depth_i) ||^2 / sigma_i^2)  over s, rho = Cauchy, by iteratively
/// reweighted Gauss-Newton; sigma_i grows with the uncertainty of the landmark's depth.
///
/// # Inputs
/// * `matches`: landmarks of the first camera and where the second sees them.
/// * `second_from_first`: rotation and direction.
/// * `start_m`: where the iteration starts, m.
/// * `noise_z1`: standard deviation of a sighting on the plane z = 1, per axis.
///
/// # Output
/// The length; `None` when no landmark tells it.
///
/// # Cost
/// O(n * 20).
///
/// # Source
/// Own derivation: the one-parameter case of [`refine_pose`](super::refine_pose()).
pub fn fit_step_length(
    matches: &[LandmarkMatch],
    second_from_first: &RelativePose,
    start_m: f64,
    noise_z1: f64,
) -> Option<StepLength> {
    let direction = second_from_first.direction;
    let (mut length_m, mut sigma_m) = (start_m, f64::INFINITY);
    for _ in 0..MAX_STEPS {
        let (mut information, mut gradient) = (0.0, 0.0);
        for m in matches {
            let ray = Vector3::new(m.reference_z1.x, m.reference_z1.y, 1.0);
            let q = second_from_first.rotation * ray + direction * (length_m * m.inverse_depth);
            if q.z <= 0.0 {
                continue;
            }
            let predicted = q.xy() / q.z;
            let along = (direction.xy() - predicted * direction.z) / q.z;
            let spread = along * (length_m * m.inverse_depth_sigma);
            let variance = noise_z1 * noise_z1 + spread.norm_squared();
            let r = predicted - m.seen_z1;
            let weight = 1.0 / (variance + r.norm_squared() / (KERNEL_SIGMAS * KERNEL_SIGMAS));
            let jacobian = along * m.inverse_depth;
            information += weight * jacobian.norm_squared();
            gradient += weight * jacobian.dot(&r);
        }
        if information.is_nan() || information <= 0.0 {
            return None;
        }
        sigma_m = 1.0 / libm::sqrt(information);
        let step = gradient / information;
        length_m = (length_m - step).max(0.0);
        if step.abs() <= NEGLIGIBLE_RATIO * length_m {
            break;
        }
    }
    length_m.is_finite().then_some(StepLength { length_m, sigma_m })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::UnitQuaternion;
    use std::vec::Vec;

    #[test]
    fn the_length_is_found_among_outliers() {
        let motion = RelativePose {
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.05, 0.0)),
            direction: Vector3::new(0.1, 0.0, -1.0).normalize(),
        };
        let mut rng = Rng::new(2, 0, 0);
        let matches: Vec<_> = (0..80)
            .map(|i| {
                let z = 5.0 + 30.0 * rng.unit_f64();
                let p = Vector3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.5 * z, z);
                let moving = if i % 4 == 0 { Vector3::new(1.0, 0.0, 2.0) } else { Vector3::zeros() };
                let q = motion.rotation * p + motion.direction * 1.7 + moving;
                LandmarkMatch {
                    reference_z1: (p / p.z).xy(),
                    inverse_depth: 1.0 / z,
                    inverse_depth_sigma: 0.01 / z,
                    seen_z1: (q / q.z).xy(),
                }
            })
            .collect();
        let found = fit_step_length(&matches, &motion, 0.5, 1e-3).expect("near landmarks");
        assert!((found.length_m - 1.7).abs() < 0.03, "{found:?}");
        assert!(found.sigma_m > 0.0 && found.sigma_m < 0.1, "{found:?}");
        let far: Vec<_> = matches.iter().map(|m| LandmarkMatch { inverse_depth: 0.0, ..*m }).collect();
        assert_eq!(fit_step_length(&far, &motion, 0.5, 1e-3), None);
        assert_eq!(fit_step_length(&[], &motion, 0.5, 1e-3), None);
    }
}
