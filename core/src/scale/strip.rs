//! The road strip in two images, and the iteration that aligns it.

use super::equations::{Fit, RoadView, equations};
use super::ground_plane::{RoadPair, RoadProblem, RoadSettings};
use super::tiles::RoadMask;
use crate::camera::{Mounting, Pinhole};
use crate::features::SimdLevel;
use crate::frame::ImageView;
use nalgebra::{SMatrix, SVector, Unit, Vector3};

/// Neighbouring pixels and the interpolation share noise: one in this many counts as independent.
const PIXELS_PER_INDEPENDENT: f64 = 16.0;
/// A step that moves the nearest road by less than this many pixels ends the iteration.
const NEGLIGIBLE_STEP_PX: f64 = 0.005;

pub(super) type Normal5 = SMatrix<f64, 5, 5>;
pub(super) type Vector5 = SVector<f64, 5>;

/// Rows and columns of the strip in one level, and the maps between its pixels and rays.
pub(super) struct Strip<'a> {
    pub(super) later: ImageView<'a>,
    pub(super) earlier: ImageView<'a>,
    pub(super) camera: Pinhole,
    mounting_height_m: f64,
    normal: Vector3<f64>,
    /// Of the vehicle's way, 1/m.
    curvature: f64,
    pub(super) settings: &'a RoadSettings,
}

impl<'a> Strip<'a> {
    pub(super) fn new(
        pair: &RoadPair<'a, '_>,
        level: usize,
        mounting: &Mounting,
        settings: &'a RoadSettings,
    ) -> Option<Self> {
        let (later, earlier) = (pair.later.level(level)?.image(), pair.earlier.level(level)?.image());
        // Levels drop odd columns, so the factor is exactly a power of two and not the ratio of the widths.
        let factor = 1.0 / f64::from(1u32 << level);
        let c = pair.camera;
        let camera = Pinhole {
            width: u32::try_from(later.width()).ok()?,
            height: u32::try_from(later.height()).ok()?,
            fx: c.fx * factor,
            fy: c.fy * factor,
            cx: c.cx * factor,
            cy: c.cy * factor,
        };
        let RoadPair { earlier_from_later, expected_normal: normal, .. } = *pair;
        // The vehicle goes on along the circle that it came on: x = curvature z^2 / 2.
        let curvature = earlier_from_later.rotation.scaled_axis().y / earlier_from_later.translation.vector.norm();
        Some(Self { later, earlier, camera, mounting_height_m: mounting.height_m, normal, curvature, settings })
    }

    /// Columns of a row that see the strip, which bends with the motion; `None` for rows above it or too near.
    pub(super) fn columns(&self, y_z1: f64) -> Option<(usize, usize)> {
        let Self { camera, normal, settings, .. } = self;
        let depth_m = self.mounting_height_m / (normal.y * y_z1 + normal.z);
        if !(depth_m >= settings.distance_m[0] && depth_m <= settings.distance_m[1]) {
            return None;
        }
        let center_m = (0.5 * self.curvature * depth_m * depth_m).clamp(-depth_m, depth_m) * settings.bend;
        let (center_px, half_px) =
            (camera.cx + camera.fx * center_m / depth_m, camera.fx * settings.half_width_m / depth_m);
        let width_px = f64::from(camera.width);
        let first = libm::ceil(center_px - half_px - 0.5).clamp(0.0, width_px) as usize;
        let end = libm::ceil(center_px + half_px - 0.5).clamp(0.0, width_px) as usize;
        (first < end).then_some((first, end))
    }

    /// Height of a row's centre on the plane z = 1.
    pub(super) fn y_z1(&self, row: usize) -> f64 {
        (row as f64 + 0.5 - self.camera.cy) / self.camera.fy
    }

    /// Ray of a pixel's centre, with z = 1.
    pub(super) fn ray(&self, column: usize, row: usize) -> Vector3<f64> {
        Vector3::new((column as f64 + 0.5 - self.camera.cx) / self.camera.fx, self.y_z1(row), 1.0)
    }

    /// Grey value of the later image.
    pub(super) fn later_at(&self, column: usize, row: usize) -> Option<f64> {
        (row < self.later.height()).then(|| self.later.row(row).get(column).map(|&grey| f64::from(grey))).flatten()
    }
}

#[derive(Clone, Copy)]
pub(super) struct Alignment {
    /// Normal over height, 1/m.
    pub(super) plane: Vector3<f64>,
    pub(super) gain: f64,
    pub(super) bias: f64,
}

impl Alignment {
    /// The road at this plane, equally bright in both images.
    pub(super) fn at(plane: Vector3<f64>) -> Self {
        Self { plane, gain: 1.0, bias: 0.0 }
    }

    /// Gauss-Newton on one level; returns the last normal equations and the fit.
    pub(super) fn iterate(
        &mut self,
        simd: SimdLevel,
        strip: &Strip<'_>,
        pair: &RoadPair<'_, '_>,
        mask: &RoadMask,
        mounting: &Mounting,
        settings: &RoadSettings,
    ) -> Result<(Normal5, Fit), RoadProblem> {
        let nearest_z1 = Vector3::new(0.0, mounting.height_m / settings.distance_m[0], 1.0);
        let px_per_plane = strip.camera.fy * pair.earlier_from_later.translation.vector.norm() * nearest_z1.y;
        let mut noise = f64::INFINITY;
        let mut last = None;
        for _ in 0..settings.max_iterations {
            let view = RoadView { strip, pair, mask };
            let (mut hessian, mut gradient, fit) = equations(simd, &view, self, noise);
            if fit.n_pixels < settings.min_pixels {
                return Err(RoadProblem::TooFewPixels { found: fit.n_pixels, needed: settings.min_pixels });
            }
            noise = fit.noise;
            let independent = 1.0 / (noise * noise * PIXELS_PER_INDEPENDENT);
            hessian *= independent;
            gradient *= independent;
            self.add_prior(pair, settings, &mut hessian, &mut gradient);
            let Some(step) = hessian.cholesky().map(|c| -c.solve(&gradient)) else {
                return Err(RoadProblem::TooFewPixels { found: 0, needed: settings.min_pixels });
            };
            let plane_step = step.fixed_rows::<3>(0).into_owned();
            self.plane += plane_step;
            self.gain += step[3];
            self.bias += step[4];
            last = Some((hessian, fit));
            if plane_step.dot(&nearest_z1).abs() * px_per_plane < NEGLIGIBLE_STEP_PX {
                break;
            }
        }
        last.ok_or(RoadProblem::TooFewPixels { found: 0, needed: settings.min_pixels })
    }

    /// The direction of the plane vector should be the expected normal's, within its uncertainty.
    fn add_prior(
        &self,
        pair: &RoadPair<'_, '_>,
        settings: &RoadSettings,
        hessian: &mut Normal5,
        gradient: &mut Vector5,
    ) {
        let normal = pair.expected_normal;
        let pitch_axis = Unit::new_normalize(Vector3::z() - normal * normal.z).into_inner();
        let roll_axis = normal.cross(&pitch_axis);
        for (axis, sigma_rad) in [(pitch_axis, settings.normal_sigma_rad[0]), (roll_axis, settings.normal_sigma_rad[1])]
        {
            let sigma = sigma_rad / pair.expected_height_m;
            let weight = 1.0 / (sigma * sigma);
            let off = axis.dot(&self.plane);
            for i in 0..3 {
                gradient[i] += weight * off * axis[i];
                for j in 0..3 {
                    hessian[(i, j)] += weight * axis[i] * axis[j];
                }
            }
        }
    }
}
