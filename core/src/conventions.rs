//! The conventions of the whole project, written once.
//!
//! | topic | convention |
//! |---|---|
//! | transform name | `target_from_source`, adjacent names cancel; `T_wc` in equations is `world_from_camera` |
//! | camera axes | x right, y down, z forward; the world is the first camera's frame, in metres |
//! | pixels | x right, y down; the **centre** of the top-left pixel is (0.5, 0.5), and intrinsics are in that system |
//! | quaternion | Hamilton, stored `[x, y, z, w]`, unit, `w >= 0` after normalisation |
//! | tangent of SE(3) | `[omega, upsilon]`: rotation first, rad then m; **left** increment `exp(delta) * camera_from_world` |
//! | tangent of Sim(3) | `[omega, upsilon, sigma]`: rad, m, natural logarithm of the scale; `x -> scale * R * x + t`; left increment |
//! | covariance of a published pose | `[theta, p]` along the world's fixed axes, rad then m: the truth is `exp(theta) * R`, position + p (ROS: the same, translation first) |
//! | scales of Gaussians | standard deviations in metres, stored as natural logarithms |
//! | color | RGB in [0, 1] exactly as the camera encoded it (gamma), blended as is, like reference 3DGS |
//! | time | integer nanoseconds, middle of the exposure |
//! | matrices | column vectors, column-major storage |

use nalgebra::{Isometry3, Quaternion, Similarity3, UnitQuaternion};

/// A rigid transform; the variable's name says between which frames (`world_from_camera`).
pub type Rigid = Isometry3<f64>;

/// A transform that also scales; named like a [`Rigid`] one.
pub type Similarity = Similarity3<f64>;

/// Nanoseconds on the capture process's clock.
pub type TimestampNs = u64;

/// Offset from an intrinsic calibration that centres pixels on integers (KITTI, OpenCV) to ours.
pub const PIXEL_CENTER_OFFSET: f64 = 0.5;

/// Quaternion in storage order `[x, y, z, w]`, with the sign that makes `w >= 0`.
pub fn quaternion_xyzw(rotation: &UnitQuaternion<f64>) -> [f64; 4] {
    let q = rotation.quaternion();
    let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
    [sign * q.i, sign * q.j, sign * q.k, sign * q.w]
}

/// Inverse of [`quaternion_xyzw`]; normalises.
pub fn rotation_from_xyzw(xyzw: [f64; 4]) -> UnitQuaternion<f64> {
    let [x, y, z, w] = xyzw;
    UnitQuaternion::new_normalize(Quaternion::new(w, x, y, z))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    #[test]
    fn quarter_turn_about_y_takes_forward_to_right() {
        let rotation =
            rotation_from_xyzw([0.0, core::f64::consts::FRAC_1_SQRT_2, 0.0, core::f64::consts::FRAC_1_SQRT_2]);
        let right = rotation * Vector3::z();
        assert!((right - Vector3::x()).norm() < 1e-12, "{right}");
    }

    #[test]
    fn stored_quaternion_has_a_positive_real_part() {
        let stored = quaternion_xyzw(&rotation_from_xyzw([0.1, 0.2, 0.3, -0.9]));
        assert!(stored[3] > 0.0);
        let back = rotation_from_xyzw(stored);
        assert!(back.angle_to(&rotation_from_xyzw([0.1, 0.2, 0.3, -0.9])) < 1e-12);
    }
}
