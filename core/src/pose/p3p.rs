//! The pose of a camera from three points.

use super::real_roots;
use crate::conventions::Rigid;
use heapless::Vec;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Most poses that three points leave open.
pub const MAX_POSES: usize = 4;

/// Triangles thinner than this (sine of an angle) do not fix the pose.
const MIN_SINE: f64 = 1e-6;

/// All poses from which three points look the way they do.
///
/// # Inputs
/// * `points_in_reference`: three points, m.
/// * `seen_z1`: where the camera sees them, on its plane z = 1, same order.
///
/// # Output
/// Up to four `camera_from_reference`; none for points on a line.
///
/// # Cost
/// Constant, about 2 microseconds.
///
/// # Source
/// Grunert's solution as given by Haralick, Lee, Ottenberg & Noelle 1994, "Review and analysis of solutions of
/// the three point perspective pose estimation problem", eq. 6-9. Own implementation; the absolute orientation
/// comes from the two triangles' own axes.
pub fn p3p(points_in_reference: &[Vector3<f64>; 3], seen_z1: &[Vector2<f64>; 3]) -> Vec<Rigid, MAX_POSES> {
    let mut poses = Vec::new();
    let [p1, p2, p3] = points_in_reference;
    let rays = seen_z1.map(|s| Vector3::new(s.x, s.y, 1.0).normalize());
    let (a2, b2, c2) = ((p2 - p3).norm_squared(), (p1 - p3).norm_squared(), (p1 - p2).norm_squared());
    let (cos_a, cos_b, cos_c) = (rays[1].dot(&rays[2]), rays[0].dot(&rays[2]), rays[0].dot(&rays[1]));
    let Some(axes_in_reference) = triangle_axes(p1, p2, p3) else { return poses };
    let (difference, sum) = ((a2 - c2) / b2, (a2 + c2) / b2);
    let (a_b, c_b) = (a2 / b2, c2 / b2);
    let quartic = [
        (1.0 + difference) * (1.0 + difference) - 4.0 * a_b * cos_c * cos_c,
        4.0 * (-difference * (1.0 + difference) * cos_b + 2.0 * a_b * cos_c * cos_c * cos_b
            - (1.0 - sum) * cos_a * cos_c),
        2.0 * (difference * difference - 1.0
            + 2.0 * difference * difference * cos_b * cos_b
            + 2.0 * (1.0 - c_b) * cos_a * cos_a
            - 4.0 * sum * cos_a * cos_b * cos_c
            + 2.0 * (1.0 - a_b) * cos_c * cos_c),
        4.0 * (difference * (1.0 - difference) * cos_b - (1.0 - sum) * cos_a * cos_c
            + 2.0 * c_b * cos_a * cos_a * cos_b),
        (difference - 1.0) * (difference - 1.0) - 4.0 * c_b * cos_a * cos_a,
    ];
    for v in real_roots(&quartic) {
        let u = ((difference - 1.0) * v * v - 2.0 * difference * cos_b * v + 1.0 + difference)
            / (2.0 * (cos_c - v * cos_a));
        let s1 = libm::sqrt(b2 / (1.0 + v * v - 2.0 * v * cos_b));
        let in_camera = [rays[0] * s1, rays[1] * (u * s1), rays[2] * (v * s1)];
        if !(u > 0.0 && v > 0.0 && s1.is_finite() && u.is_finite()) {
            continue;
        }
        if let Some(axes_in_camera) = triangle_axes(&in_camera[0], &in_camera[1], &in_camera[2]) {
            let matrix = axes_in_camera * axes_in_reference.transpose();
            let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix));
            let translation = in_camera[0] - rotation * p1;
            let _ = poses.push(Rigid::from_parts(Translation3::from(translation), rotation));
        }
    }
    poses
}

/// Right-handed orthonormal axes fixed to a triangle; `None` when it is a line.
fn triangle_axes(p1: &Vector3<f64>, p2: &Vector3<f64>, p3: &Vector3<f64>) -> Option<Matrix3<f64>> {
    let (first, second) = (p2 - p1, p3 - p1);
    let normal = first.cross(&second);
    if normal.norm().is_nan() || normal.norm() <= MIN_SINE * first.norm() * second.norm() {
        return None;
    }
    let (x, z) = (first.normalize(), normal.normalize());
    Some(Matrix3::from_columns(&[x, z.cross(&x), z]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Rng, se3};
    use nalgebra::{Point3, Vector6};

    #[test]
    fn one_of_the_poses_is_the_true_one() {
        let mut rng = Rng::new(4, 0, 0);
        let camera_from_reference = se3::exp(&Vector6::new(0.1, -0.3, 0.05, 0.5, -0.2, -1.5));
        let mut solved = 0;
        for _ in 0..100 {
            let points = core::array::from_fn(|_| {
                let z = 6.0 + 30.0 * rng.unit_f64();
                Vector3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.5 * z, z)
            });
            let seen = points.map(|p| {
                let q = camera_from_reference * Point3::from(p);
                (q.coords / q.z).xy()
            });
            let error = p3p(&points, &seen)
                .iter()
                .map(|found| se3::log(&(found * camera_from_reference.inverse())).norm())
                .fold(f64::INFINITY, f64::min);
            solved += usize::from(error < 1e-5);
        }
        assert!(solved >= 98, "{solved} of 100");
    }

    #[test]
    fn points_on_a_line_give_nothing() {
        let points = [1.0, 2.0, 3.0].map(|k| Vector3::new(k, k, 5.0 + k));
        assert!(p3p(&points, &points.map(|p| (p / p.z).xy())).is_empty());
        assert!(p3p(&[Vector3::repeat(f64::NAN); 3], &[Vector2::zeros(); 3]).is_empty());
    }
}
