//! Exponential and logarithm of rigid motions.
//!
//! Tangent order and side of the increment: [`conventions`](crate::conventions).

use crate::conventions::Rigid;
use nalgebra::{Matrix3, Translation3, UnitQuaternion, Vector3, Vector6};

/// Below this angle the closed forms lose digits and their Taylor series are exact to f64.
const SMALL_ANGLE_RAD: f64 = 1e-4;

/// Cross-product matrix: `skew(a) * b = a x b`.
///
/// # Source
/// Sola, Deray & Atchuthan 2018, eq. 60.
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// Rigid motion of the tangent vector `[omega, upsilon]` (rad, m).
///
/// # Source
/// Sola, Deray & Atchuthan 2018, eq. 172-175, with `[omega, upsilon]` swapped to our order.
pub fn exp(tangent: &Vector6<f64>) -> Rigid {
    let omega = Vector3::new(tangent[0], tangent[1], tangent[2]);
    let upsilon = Vector3::new(tangent[3], tangent[4], tangent[5]);
    let rotation = UnitQuaternion::from_scaled_axis(omega);
    let translation = left_jacobian(&omega) * upsilon;
    Rigid::from_parts(Translation3::from(translation), rotation)
}

/// Tangent vector `[omega, upsilon]` (rad, m) of a rigid motion; inverse of [`exp`].
///
/// # Source
/// Sola, Deray & Atchuthan 2018, eq. 173-175.
pub fn log(motion: &Rigid) -> Vector6<f64> {
    let omega = motion.rotation.scaled_axis();
    let upsilon = match left_jacobian(&omega).try_inverse() {
        Some(inverse) => inverse * motion.translation.vector,
        // The Jacobian is singular only at whole turns, which `scaled_axis` never returns.
        None => motion.translation.vector,
    };
    Vector6::new(omega.x, omega.y, omega.z, upsilon.x, upsilon.y, upsilon.z)
}

/// Left Jacobian of SO(3), `V(omega)`.
fn left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle2 = omega.norm_squared();
    let angle = libm::sqrt(angle2);
    let w = skew(omega);
    let (a, b) = if angle < SMALL_ANGLE_RAD {
        (0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0)
    } else {
        ((1.0 - libm::cos(angle)) / angle2, (angle - libm::sin(angle)) / (angle2 * angle))
    };
    Matrix3::identity() + w * a + w * w * b
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_undoes_exp_at_and_around_the_small_angle_branch() {
        for angle in [0.0, 1e-9, 0.99e-4, 1.01e-4, 0.3, 3.1] {
            let axis = Vector3::new(1.0, -2.0, 0.5).normalize() * angle;
            let tangent = Vector6::new(axis.x, axis.y, axis.z, 0.4, -7.0, 2.0);
            let back = log(&exp(&tangent));
            assert!((back - tangent).norm() < 1e-9, "angle {angle}: {back}");
        }
    }

    #[test]
    fn a_quarter_circle_ends_where_it_should() {
        // Driving forward (z) at 1 m/rad while turning right about y (down) for a quarter turn.
        let quarter = core::f64::consts::FRAC_PI_2;
        let motion = exp(&Vector6::new(0.0, quarter, 0.0, 0.0, 0.0, quarter));
        assert!((motion.translation.vector - Vector3::new(1.0, 0.0, 1.0)).norm() < 1e-12);
    }
}
