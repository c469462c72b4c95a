//! The rotation that explains matches best, as if the camera had only turned.

use super::Match;
use crate::math::se3::skew;
use nalgebra::{Matrix2x3, Matrix3, UnitQuaternion, Vector3};

/// Steps of the fit; the first ones halve the kernel, so that a start some degrees off finds the way.
const N_STEPS: i32 = 8;
/// Width of Cauchy's kernel in the end, standard deviations (95 % efficiency).
const KERNEL_SIGMAS: f64 = 2.385;

/// Turns `start` until `second = pi(R first)` holds as well as it can over all matches, moving ones and near ones discounted.
///
/// # Inputs
/// * `start`: within some degrees of the answer.
/// * `noise_z1`: standard deviation of a match per axis, on the plane z = 1.
///
/// # Output
/// `second_from_first`; `None` with less than two directions to hold on to.
///
/// # Source
/// Gauss-Newton with Cauchy's weights (Holland & Welsch 1977), the kernel halved from step to step. Own implementation.
pub fn fit_turn(matches: &[Match], start: &UnitQuaternion<f64>, noise_z1: f64) -> Option<UnitQuaternion<f64>> {
    let mut rotation = *start;
    for step in 0..N_STEPS {
        let width_z1 = KERNEL_SIGMAS * noise_z1 * f64::from(1 << (N_STEPS - 2 - step).max(0));
        let (mut information, mut gradient) = (Matrix3::zeros(), Vector3::zeros());
        for found in matches {
            let turned = rotation * Vector3::new(found.first_z1.x, found.first_z1.y, 1.0);
            if turned.z <= 0.0 {
                continue;
            }
            let z1 = turned.xy() / turned.z;
            let onto_plane = Matrix2x3::new(1.0, 0.0, -z1.x, 0.0, 1.0, -z1.y) / turned.z;
            let jacobian = -onto_plane * skew(&turned);
            let off = found.second_z1 - z1;
            let weight = 1.0 / (1.0 + off.norm_squared() / (width_z1 * width_z1));
            information += jacobian.transpose() * jacobian * weight;
            gradient += jacobian.transpose() * off * weight;
        }
        let turn = information.cholesky()?.solve(&gradient);
        rotation = UnitQuaternion::from_scaled_axis(turn) * rotation;
    }
    // From frame to frame each start is a product of earlier answers: their lengths would drift apart.
    rotation.renormalize();
    rotation.coords.iter().all(|c| c.is_finite()).then_some(rotation)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::Vector2;
    use std::vec::Vec;

    const NOISE_Z1: f64 = 5e-4;

    /// Points between 3 and 60 m, seen before and after a turn and a shift; the first `n_moving` go their own way.
    fn matches(rotation: &UnitQuaternion<f64>, shift_m: Vector3<f64>, n_moving: usize) -> Vec<Match> {
        let mut rng = Rng::new(3, 0, 0);
        (0..200)
            .map(|i| {
                let z = 3.0 + 57.0 * rng.unit_f64();
                let point = Vector3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.4 * z, z);
                let own = if i < n_moving { 0.05 * z } else { 0.0 };
                let seen = rotation * point + shift_m + Vector3::x() * own;
                let noise = Vector2::new(rng.unit_f64() - 0.5, rng.unit_f64() - 0.5) * NOISE_Z1;
                Match { first_z1: point.xy() / point.z, second_z1: seen.xy() / seen.z + noise }
            })
            .collect()
    }

    #[test]
    fn a_turn_is_found_from_a_start_that_is_off() {
        let check = |axis_angle: [f64; 3], start_off_rad: f64, n_moving: usize| {
            let rotation = UnitQuaternion::from_scaled_axis(axis_angle.into());
            let start = UnitQuaternion::from_scaled_axis(Vector3::y() * start_off_rad) * rotation;
            let found = fit_turn(&matches(&rotation, Vector3::zeros(), n_moving), &start, NOISE_Z1).expect("a turn");
            let error_rad = found.angle_to(&rotation);
            assert!(error_rad < 1e-4, "{axis_angle:?} from {start_off_rad}, {n_moving} moving: {error_rad}");
        };
        check([0.0, 0.03, 0.0], 0.0, 0);
        check([0.01, -0.05, 0.02], 0.05, 0);
        check([0.0, 0.03, 0.0], -0.03, 60);
        check([0.0; 3], 0.02, 80);
    }

    #[test]
    fn without_directions_there_is_no_turn() {
        let identity = UnitQuaternion::identity();
        assert_eq!(fit_turn(&[], &identity, NOISE_Z1), None);
        let one = Match { first_z1: Vector2::zeros(), second_z1: Vector2::zeros() };
        assert_eq!(fit_turn(&[one; 4], &identity, NOISE_Z1), None);
        let nan = Match { first_z1: Vector2::zeros(), second_z1: Vector2::repeat(f64::NAN) };
        assert_eq!(fit_turn(&[nan; 4], &identity, NOISE_Z1), None);
    }
}
