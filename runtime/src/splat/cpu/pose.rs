//! Gradients with respect to the camera's pose: their sum, and the sky's part.
//!
//! The parts of the Gaussians are found where their own gradients are (`update`, `decode_anchors_backward`).

use super::grid::Grid;
use super::lane::each;
use super::simd::Dispatch;
use super::sky::{Corners, LOOKUP, Rays, SKY_BANDS, lookup_columns};
use crate::pool::Pool;
use crate::splat::kernel_constants::MAX_GRADIENT;
use crate::splat::{
    BACKGROUND_COLUMNS, BACKGROUND_MAX_ELEVATION_RAD, BACKGROUND_MIN_ELEVATION_RAD, BACKGROUND_ROWS, PoseGradient,
};
use core::f64::consts::TAU;
use pulp::{Simd, WithSimd};

/// A sum of gradients; see [`PoseGradient`] for the tangent.
#[derive(Clone, Copy, Debug, Default)]
pub struct PoseSum(pub PoseGradient);

impl PoseSum {
    /// Adds a part; one that is no number, or the product of an overflow, is left out.
    pub fn add(&mut self, part: PoseGradient) {
        if part.iter().all(|v| v.abs() < f64::from(MAX_GRADIENT)) {
            self.0.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
        }
    }
}

/// The sky as it was drawn, and the gradients of the picture.
#[derive(Clone, Copy)]
pub struct SeenSky<'a> {
    /// Rays of the view.
    pub rays: &'a Rays,
    /// Size of the picture.
    pub grid: Grid,
    /// The chunk's table.
    pub texels: &'a [[f32; 3]],
    /// How much of it every pixel shows.
    pub transmittance: &'a [f32],
    /// Gradients with respect to red, green and blue.
    pub grad_rgb: [&'a [f32]; 3],
}

impl SeenSky<'_> {
    /// Sum over the pixels of `ray x dL/dray`, in map axes; the camera's `omega`, turned into them, has minus that as
    /// its gradient.
    pub fn ray_torque(&self, pool: &Pool, dispatch: Dispatch) -> [f64; 3] {
        let band_rows = self.grid.height.div_ceil(SKY_BANDS);
        let mut bands: [(usize, [f64; 3]); SKY_BANDS] = core::array::from_fn(|band| (band, [0.0; 3]));
        pool.for_each(&mut bands, |_, (band, torque)| {
            for y in *band * band_rows..((*band + 1) * band_rows).min(self.grid.height) {
                dispatch.run(TorqueOfRow { sky: self, y, torque });
            }
        });
        bands.iter().fold([0.0; 3], |sum, (_, part)| each!(i in 3 => sum[i] + part[i]))
    }
}

struct TorqueOfRow<'a> {
    sky: &'a SeenSky<'a>,
    y: usize,
    torque: &'a mut [f64; 3],
}

impl WithSimd for TorqueOfRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { sky, y, torque } = self;
        let width = sky.grid.width;
        for first in (0..width).step_by(LOOKUP) {
            let [columns, rows] = lookup_columns(simd, sky.rays, first, y);
            for lane in 0..LOOKUP.min(width - first) {
                let at = y * width + first + lane;
                let grad = each!(i in 3 => sky.grad_rgb[i][at] * sky.transmittance[at]);
                let slopes = texel_slopes(sky.texels, columns[lane], rows[lane], &grad);
                let part = ray_torque(&sky.rays.direction(first + lane, y), slopes);
                // A ray straight up or down has no azimuth.
                if part.iter().all(|v| v.abs() < f64::from(MAX_GRADIENT)) {
                    *torque = each!(i in 3 => torque[i] + part[i]);
                }
            }
        }
    }
}

/// `grad . dcolor` per column and per row of the table.
#[inline(always)]
fn texel_slopes(texels: &[[f32; 3]], column: f32, row: f32, grad: &[f32; 3]) -> [f32; 2] {
    let Corners { at, between: [x, y], .. } = Corners::new(column, row);
    let [up_left, up_right, down_left, down_right] = at.map(|at| {
        let [red, green, blue] = texels[at];
        red * grad[0] + green * grad[1] + blue * grad[2]
    });
    let per_column = (1.0 - y) * (up_right - up_left) + y * (down_right - down_left);
    let per_row = (1.0 - x) * (down_left - up_left) + x * (down_right - up_right);
    // Below the table every ray sees the lowest row; above it both rows are the highest one.
    [per_column, if row > 0.0 { per_row } else { 0.0 }]
}

/// `ray x d(slopes . [column, row])/dray`.
///
/// # Source
/// Own derivation: with `h^2 = x^2 + z^2`, the azimuth `atan2(x, z)` gives `[-x y / h^2, 1, -y z / h^2]`, the elevation
/// `atan2(-y, h)` gives `[z / h, 0, -x / h]`; the length of the ray does not matter.
#[inline(always)]
pub fn ray_torque(ray: &[f64; 3], slopes: [f32; 2]) -> [f64; 3] {
    const COLUMNS_PER_RAD: f64 = BACKGROUND_COLUMNS as f64 / TAU;
    const ROWS_PER_RAD: f64 =
        BACKGROUND_ROWS as f64 / (BACKGROUND_MAX_ELEVATION_RAD as f64 - BACKGROUND_MIN_ELEVATION_RAD as f64);
    let [x, y, z] = *ray;
    let h2 = x * x + z * z;
    let h = h2.sqrt();
    let by_azimuth = f64::from(slopes[0]) * COLUMNS_PER_RAD;
    let by_elevation = f64::from(slopes[1]) * ROWS_PER_RAD;
    [by_elevation * z / h - by_azimuth * x * y / h2, by_azimuth, -by_elevation * x / h - by_azimuth * y * z / h2]
}
