//! From a sampled pixel to a Gaussian: back-projection, quantisation, first shape.

use super::anchor::GaussianParams;
use super::lod;
use super::voxel::VoxelKey;
use crate::camera::Pinhole;
use nalgebra::{Matrix3, UnitQuaternion, Vector3};

/// First values of a Gaussian that its pixel does not tell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpawnSettings {
    /// Opacity at the start, (0, 1). Method section 11 asks for 0.1 to 0.2 where iterations are plenty.
    pub opacity: f32,
    /// Largest ratio of the axes within the surface: how much a grazing view may stretch a Gaussian along the
    /// surface, at least 1.
    pub max_stretch: f64,
    /// Thickness across the surface relative to the smaller axis within it, (0, 1].
    pub flatness: f64,
}

impl SpawnSettings {
    /// The values that the shipped maps were measured with.
    pub const MEASURED: Self = Self { opacity: 0.5, max_stretch: 6.0, flatness: 0.3 };
}

/// A pixel with everything that its Gaussian needs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceSample {
    /// Centre of the pixel at mapping resolution, px.
    pub pixel: [f64; 2],
    /// Inverse of the depth along the optical axis, 1/m, above 0.
    pub inverse_depth: f64,
    /// Change of the inverse depth per pixel to the right and down, 1/m/px.
    pub inverse_depth_slope: [f64; 2],
    /// Standard deviation in the image, px.
    pub sigma_px: f64,
    /// Color of the pixel, RGB in [0, 1].
    pub color: [f32; 3],
}

impl SurfaceSample {
    /// The point in the keyframe's frame, m.
    pub fn point_in_keyframe(&self, camera: &Pinhole) -> Vector3<f64> {
        self.ray_z1(camera) / self.inverse_depth
    }

    fn ray_z1(&self, camera: &Pinhole) -> Vector3<f64> {
        let [u, v] = self.pixel;
        Vector3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0)
    }
}

/// Voxels in which a surface point gets an anchor: the level of its distance, and the neighbouring level in the
/// overlap between two bands. The distance that decides is that of the voxel's centre, because that is
/// where a renderer will see the anchor; a voxel whose centre lies outside its level's range is left out.
pub fn voxels_for(point_in_map: &Vector3<f64>, camera_in_map: &Vector3<f64>) -> [Option<VoxelKey>; 2] {
    let distance_m = (point_in_map - camera_in_map).norm() as f32;
    let level = lod::level_at(distance_m);
    [Some(level), lod::overlapping_level_at(distance_m)].map(|level| {
        let key = VoxelKey::containing(level?, [point_in_map.x, point_in_map.y, point_in_map.z])?;
        let center_distance_m = (Vector3::from(key.center_in_map_m()) - camera_in_map).norm() as f32;
        (lod::band_opacity(key.level(), center_distance_m) > 0.0).then_some(key)
    })
}

/// A logit beyond this is as good as black or white, and would hardly ever come back.
const MAX_COLOR: f32 = 0.98;
/// Smallest standard deviation in units of the anchor's extent.
const MIN_SCALE_RATIO: f64 = 1e-3;

/// First shape: a disc within the surface whose picture is a circle of `sigma_px`, thin across the surface.
///
/// With `X(u, v) = ray(u, v) / w(u, v)` the tangents of the surface per pixel are
/// `dX/du = (e_x / fx - ray w_u / w) / w`, and the covariance `sigma^2 (X_u X_u^T + X_v X_v^T)` projects to
/// `sigma^2 I`. Own derivation.
pub fn initial_gaussian(
    sample: &SurfaceSample,
    camera: &Pinhole,
    anchor_in_keyframe: &Vector3<f64>,
    extent_m: f64,
    settings: &SpawnSettings,
) -> GaussianParams {
    let (ray, depth_m) = (sample.ray_z1(camera), 1.0 / sample.inverse_depth);
    let (slope_u, slope_v) = limited_slope(sample, camera, settings.max_stretch);
    let tangent_u = (Vector3::x() / camera.fx - ray * slope_u) * (depth_m * sample.sigma_px);
    let tangent_v = (Vector3::y() / camera.fy - ray * slope_v) * (depth_m * sample.sigma_px);
    let (rotation, sigmas_m) = disc(&tangent_u, &tangent_v, settings.flatness);
    let offset = (ray * depth_m - anchor_in_keyframe) / extent_m;
    let q = rotation.quaternion();
    GaussianParams {
        offset: [offset.x as f32, offset.y as f32, offset.z as f32],
        log_scale: sigmas_m.map(|sigma_m| libm::log((sigma_m / extent_m).max(MIN_SCALE_RATIO)) as f32),
        quaternion_xyzw: [q.i as f32, q.j as f32, q.k as f32, q.w as f32],
        opacity_logit: logit(settings.opacity),
        color_logit: sample.color.map(|c| logit(c.clamp(1.0 - MAX_COLOR, MAX_COLOR))),
    }
}

/// Relative slope of the inverse depth, per pixel, limited so that the disc is at most `max_stretch` times as
/// long as it is wide.
fn limited_slope(sample: &SurfaceSample, camera: &Pinhole, max_stretch: f64) -> (f64, f64) {
    let [slope_u, slope_v] = sample.inverse_depth_slope.map(|slope| slope / sample.inverse_depth);
    // In units of the lateral size of a pixel, this is the tangent of the angle between surface and image plane.
    let tangent =
        libm::sqrt((slope_u * camera.fx) * (slope_u * camera.fx) + (slope_v * camera.fy) * (slope_v * camera.fy));
    let limit = libm::sqrt((max_stretch * max_stretch - 1.0).max(0.0));
    let shrink = if tangent > limit { limit / tangent } else { 1.0 };
    (slope_u * shrink, slope_v * shrink)
}

/// Axes and standard deviations of the disc spanned by two tangents.
fn disc(tangent_u: &Vector3<f64>, tangent_v: &Vector3<f64>, flatness: f64) -> (UnitQuaternion<f64>, [f64; 3]) {
    // Principal axes of the 2x2 Gram matrix [a b; b c] of the tangents (Jacobi rotation).
    let (a, b, c) = (tangent_u.norm_squared(), tangent_u.dot(tangent_v), tangent_v.norm_squared());
    let angle_rad = 0.5 * libm::atan2(2.0 * b, a - c);
    let (sin, cos) = (libm::sin(angle_rad), libm::cos(angle_rad));
    let long = tangent_u * cos + tangent_v * sin;
    let short = tangent_v * cos - tangent_u * sin;
    let (long_m, short_m) = (long.norm(), short.norm());
    let (x, y) = (long / long_m, short / short_m);
    let axes = Matrix3::from_columns(&[x, y, x.cross(&y)]);
    (UnitQuaternion::from_matrix(&axes), [long_m, short_m, short_m.min(long_m) * flatness])
}

/// Inverse of the logistic function.
fn logit(p: f32) -> f32 {
    libm::logf(p / (1.0 - p))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { width: 100, height: 60, fx: 80.0, fy: 80.0, cx: 50.0, cy: 30.0 };

    fn sample(pixel: [f64; 2], depth_m: f64, slope: [f64; 2]) -> SurfaceSample {
        let inverse_depth = 1.0 / depth_m;
        SurfaceSample { pixel, inverse_depth, inverse_depth_slope: slope, sigma_px: 2.0, color: [0.5, 0.0, 1.0] }
    }

    /// Covariance in the keyframe's frame, m^2.
    fn covariance(gaussian: &GaussianParams, extent_m: f64) -> Matrix3<f64> {
        let [x, y, z, w] = gaussian.quaternion_xyzw.map(f64::from);
        let axes = crate::conventions::rotation_from_xyzw([x, y, z, w]).to_rotation_matrix();
        let sigmas = Vector3::from(gaussian.log_scale.map(|s| libm::exp(f64::from(s)) * extent_m));
        axes.matrix() * Matrix3::from_diagonal(&sigmas.component_mul(&sigmas)) * axes.matrix().transpose()
    }

    #[test]
    fn the_picture_of_a_flat_disc_is_a_circle_of_the_asked_size() {
        // Facing, a road 1.65 m below, a wall that recedes to the right.
        for (pixel, depth_m, slope) in [
            ([50.0, 30.0], 10.0, [0.0, 0.0]),
            ([40.0, 50.0], 6.6, [0.0, 1.0 / (80.0 * 1.65)]),
            ([80.0, 25.0], 8.0, [-0.002, 0.0]),
        ] {
            let sample = sample(pixel, depth_m, slope);
            let settings = SpawnSettings { opacity: 0.15, max_stretch: 20.0, flatness: 1e-3 };
            let gaussian = initial_gaussian(&sample, &CAMERA, &Vector3::zeros(), 0.5, &settings);
            let point = sample.point_in_keyframe(&CAMERA);
            let z = point.z;
            let jacobian = nalgebra::Matrix2x3::new(
                CAMERA.fx / z,
                0.0,
                -CAMERA.fx * point.x / (z * z),
                0.0,
                CAMERA.fy / z,
                -CAMERA.fy * point.y / (z * z),
            );
            let picture = jacobian * covariance(&gaussian, 0.5) * jacobian.transpose();
            let circle = nalgebra::Matrix2::identity() * 4.0;
            assert!((picture - circle).norm() < 0.05, "{pixel:?}: {picture}");
        }
    }

    #[test]
    fn a_road_gaussian_lies_in_the_road_and_is_no_longer_than_allowed() {
        let road = sample([50.0, 34.0], 33.0, [0.0, 1.0 / (80.0 * 1.65)]);
        let settings = SpawnSettings { opacity: 0.15, max_stretch: 5.0, flatness: 0.3 };
        let gaussian = initial_gaussian(&road, &CAMERA, &Vector3::new(0.0, 0.0, 30.0), 1.0, &settings);
        let ratio = libm::exp(f64::from(gaussian.log_scale[0] - gaussian.log_scale[1]));
        assert!((ratio - 5.0).abs() < 0.1, "{ratio}");
        assert!((gaussian.offset[2] - 3.0).abs() < 1e-5 && (gaussian.offset[1] - 1.65).abs() < 1e-5);
        assert!((gaussian.opacity_logit - libm::logf(0.15 / 0.85)).abs() < 1e-6);
        assert!(gaussian.color_logit[0].abs() < 1e-6 && gaussian.color_logit.iter().all(|c| c.is_finite()));
    }

    #[test]
    fn a_point_near_a_border_gets_two_voxels_and_one_elsewhere() {
        let camera_in_map = Vector3::new(0.0, 0.0, 100.0);
        let levels = |distance_m: f64| {
            voxels_for(&Vector3::new(0.02, 0.02, 100.0 + distance_m), &camera_in_map)
                .map(|key| key.map(VoxelKey::level))
        };
        assert_eq!(levels(5.0), [Some(0), None]);
        assert_eq!(levels(19.5), [Some(0), Some(1)]);
        assert_eq!(levels(41.0), [Some(2), Some(1)]);
        assert_eq!(levels(60.0), [Some(2), None]);
    }
}
