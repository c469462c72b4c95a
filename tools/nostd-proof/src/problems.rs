//! The tracking problems that the proof solves, each with the answer known beforehand.

use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::math::{Rng, se3};
use nalgebra::{Matrix2x3, Matrix2x6, Matrix3x6, Matrix6, Vector2, Vector3, Vector6};

const CAMERA: Pinhole = Pinhole { width: 160, height: 120, fx: 120.0, fy: 120.0, cx: 80.0, cy: 60.0 };
const N_POINTS: usize = 64;

/// Solves every problem; the error names the one whose answer was wrong.
pub fn solve_all() -> Result<(), &'static str> {
    pose_from_points()
}

/// Points ahead of the camera, the same in every run.
fn points_in_world() -> [Vector3<f64>; N_POINTS] {
    let mut rng = Rng::new(1, 2, 3);
    core::array::from_fn(|_| {
        let mut side = |half_width_m: f64| (2.0 * rng.unit_f64() - 1.0) * half_width_m;
        Vector3::new(side(4.0), side(2.0), 9.0 + side(4.0))
    })
}

/// Finds a camera from where it sees known points, by Gauss-Newton from the identity.
fn pose_from_points() -> Result<(), &'static str> {
    let true_camera_from_world = se3::exp(&Vector6::new(0.02, -0.05, 0.01, 0.2, -0.1, -0.6));
    let points_in_world = points_in_world();
    let mut camera_from_world = Rigid::identity();
    for _ in 0..10 {
        let mut information = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for point_in_world in &points_in_world {
            let Some(seen) = CAMERA.project(&(true_camera_from_world * nalgebra::Point3::from(*point_in_world)).coords)
            else {
                return Err("a point lies behind the true camera");
            };
            let point_in_camera = (camera_from_world * nalgebra::Point3::from(*point_in_world)).coords;
            let Some((predicted, jacobian)) = projection_with_jacobian(&point_in_camera) else {
                return Err("a point lies behind the estimated camera");
            };
            information += jacobian.transpose() * jacobian;
            gradient += jacobian.transpose() * (predicted - seen);
        }
        let Some(factor) = information.cholesky() else { return Err("the normal equations are singular") };
        camera_from_world = se3::exp(&-factor.solve(&gradient)) * camera_from_world;
    }
    let error = se3::log(&(camera_from_world * true_camera_from_world.inverse())).norm();
    if error < 1e-9 { Ok(()) } else { Err("the pose from points is wrong") }
}

/// Pixel of a point, and its derivative by a left increment of `camera_from_world`.
fn projection_with_jacobian(point_in_camera: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x6<f64>)> {
    let pixel = CAMERA.project(point_in_camera)?;
    let (x, y, z) = (point_in_camera.x, point_in_camera.y, point_in_camera.z);
    let by_point =
        Matrix2x3::new(CAMERA.fx / z, 0.0, -CAMERA.fx * x / (z * z), 0.0, CAMERA.fy / z, -CAMERA.fy * y / (z * z));
    let mut by_tangent = Matrix3x6::zeros();
    by_tangent.fixed_columns_mut::<3>(0).copy_from(&-se3::skew(point_in_camera));
    by_tangent.fixed_columns_mut::<3>(3).fill_with_identity();
    Some((pixel, by_point * by_tangent))
}
