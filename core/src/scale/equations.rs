//! The normal equations of the road's alignment, four pixels at a time.

use super::ground_plane::{RoadPair, RoadSettings};
use super::strip::{Alignment, Normal5, Strip, Vector5, columns};
use super::tiles::RoadMask;
use crate::features::SimdLevel;
use crate::features::lanes::{Kernel, KernelTask};
use crate::frame::ImageView;
use nalgebra::{Matrix3, Vector3};

/// Width of Tukey's kernel in standard deviations (95 % efficiency).
const TUKEY_SIGMAS: f64 = 4.685;
/// Standard deviation over mean absolute deviation of Gaussian noise.
const SIGMA_PER_MEAN_ABSOLUTE: f64 = 1.2533;
/// Camera noise and rounding, grey values: a residual is never weighed as if it were smaller.
const MIN_NOISE_GREY: f64 = 1.0;
/// Pixels beside each other that are computed together: four 64-bit numbers are a register.
const LANES: usize = 4;

/// A number per pixel.
type Four = [f64; LANES];

/// How well the strips agree.
pub(super) struct Fit {
    pub(super) n_pixels: usize,
    pub(super) correlation: f64,
    pub(super) noise: f64,
}

/// What the equations look at.
pub(super) struct RoadView<'a, 'm, 's> {
    pub(super) strip: &'s Strip<'a>,
    pub(super) pair: &'s RoadPair<'a, 'm>,
    pub(super) mask: &'s RoadMask,
    pub(super) mounting_height_m: f64,
    pub(super) settings: &'s RoadSettings,
}

/// Normal equations (lower triangle) over the strip's pixels that show the road. An infinite `noise` weighs all pixels alike.
///
/// Pixels are added one after the other in raster order, so that every SIMD level gives the same bits.
pub(super) fn equations(
    simd: SimdLevel,
    view: &RoadView<'_, '_, '_>,
    alignment: &Alignment,
    noise: f64,
) -> (Normal5, Vector5, Fit) {
    let mut sums = Sums::default();
    let rotation = *view.pair.earlier_from_later.rotation.to_rotation_matrix().matrix();
    let translation = view.pair.earlier_from_later.translation.vector;
    simd.run(Scan { view, alignment, noise, rotation, translation, sums: &mut sums });
    sums.finish()
}

/// Sums over the pixels of products of the row (d0, d1, d2, value, 1) of the Jacobian, its residual and its weight.
#[derive(Default)]
struct Sums {
    /// Weighted products of d0, d1, d2 and value (first index) with each other.
    squares: [Four; LANES],
    /// Weighted products of the residual with d0, d1, d2 and value.
    gradient: Four,
    /// Weighted d0, d1, d2 and value.
    row: Four,
    /// Weights, weighted grey values of the later image, residuals, and their absolute values.
    plain: Four,
    /// Weighted products of the later grey value with value and with itself.
    later: Four,
    n_pixels: usize,
}

impl Sums {
    #[inline(always)]
    fn add(&mut self, row: Four, weight: f64, later: f64, residual: f64) {
        for (sums, factor) in self.squares.iter_mut().zip(row) {
            add_scaled(sums, weight * factor, row);
        }
        add_scaled(&mut self.gradient, weight * residual, row);
        add_scaled(&mut self.row, weight, row);
        add_scaled(&mut self.plain, weight, [1.0, later, residual, residual.abs()]);
        add_scaled(&mut self.later, later, [weight * row[3], weight * later, 0.0, 0.0]);
        self.n_pixels += 1;
    }

    fn finish(&self) -> (Normal5, Vector5, Fit) {
        let [n, b, residual, absolute] = self.plain;
        let hessian = Normal5::from_fn(|i, j| match (i, j) {
            (4, 4) => n,
            (4, j) => self.row[j],
            (i, j) if i >= j => self.squares[j][i],
            _ => 0.0,
        });
        let gradient = Vector5::from_fn(|i, _| if i == 4 { residual } else { self.gradient[i] });
        let (a, aa, [ab, bb, ..]) = (self.row[3], self.squares[3][3], self.later);
        let covariance = ab - a * b / n;
        let (va, vb) = (aa - a * a / n, bb - b * b / n);
        let correlation = covariance / libm::sqrt(va * vb).max(f64::MIN_POSITIVE);
        let mean_absolute = absolute / n.max(f64::MIN_POSITIVE);
        let noise = (SIGMA_PER_MEAN_ABSOLUTE * mean_absolute).max(MIN_NOISE_GREY);
        (hessian, gradient, Fit { n_pixels: self.n_pixels, correlation, noise })
    }
}

#[inline(always)]
fn add_scaled(sums: &mut Four, factor: f64, values: Four) {
    for i in 0..LANES {
        sums[i] += factor * values[i];
    }
}

struct Scan<'a, 'm, 's> {
    view: &'s RoadView<'a, 'm, 's>,
    alignment: &'s Alignment,
    noise: f64,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
    sums: &'s mut Sums,
}

impl KernelTask for Scan<'_, '_, '_> {
    #[inline(always)]
    fn run<K: Kernel>(self, _kernel: K) {
        let RoadView { strip, pair, mounting_height_m, settings, .. } = *self.view;
        let mut sums = Sums::default();
        for row in 0..strip.later.height() {
            let y = strip.y_z1(row);
            let Some((first, end)) = columns(pair, mounting_height_m, settings, &strip.camera, y) else {
                continue;
            };
            for column in (first..end).step_by(LANES) {
                self.add_four(row, column, end, &mut sums);
            }
        }
        *self.sums = sums;
    }
}

impl Scan<'_, '_, '_> {
    /// Adds the pixels of a row from `column` on, as far as they lie before `end`.
    #[inline(always)]
    fn add_four(&self, row: usize, column: usize, end: usize, sums: &mut Sums) {
        let (strip, mask) = (self.view.strip, self.view.mask);
        let (c, t, r, plane) = (&strip.camera, &self.translation, &self.rotation, &self.alignment.plane);
        let y = strip.y_z1(row);
        let excluded = mask.row(y);
        let (first, mut is_used) = (column as f64, [false; LANES]);
        let [mut x, mut u, mut v, mut inverse_z, mut x_px, mut y_px] = [[0.0; LANES]; 6];
        for i in 0..LANES {
            x[i] = (first + i as f64 + 0.5 - c.cx) / c.fx;
            let shift = plane.x * x[i] + plane.y * y + plane.z;
            let [qx, qy, qz] = [0, 1, 2].map(|k| r[(k, 0)] * x[i] + r[(k, 1)] * y + r[(k, 2)] + t[k] * shift);
            inverse_z[i] = 1.0 / qz;
            (u[i], v[i]) = (qx * inverse_z[i], qy * inverse_z[i]);
            (x_px[i], y_px[i]) = (c.fx * u[i] + c.cx, c.fy * v[i] + c.cy);
        }
        for i in 0..LANES {
            is_used[i] = column + i < end && !mask.excludes(excluded, x[i]);
        }
        let samples = Samples::read(&strip.earlier, x_px, y_px, &mut is_used);
        if is_used == [false; LANES] {
            return;
        }
        let later = grey_values(&strip.later, column, row);
        let still = grey_values(&strip.earlier, column, row);
        let (gain, bias) = (self.alignment.gain, self.alignment.bias);
        let standing2 = self.view.settings.standing_grey * self.view.settings.standing_grey;
        let Samples { value, gradient_x, gradient_y } = samples;
        let [mut residual, mut weight, mut along] = [[0.0; LANES]; 3];
        for i in 0..LANES {
            residual[i] = gain * value[i] + bias - later[i];
            let ratio = residual[i] / (TUKEY_SIGMAS * self.noise);
            let tukey = if ratio.abs() < 1.0 { (1.0 - ratio * ratio) * (1.0 - ratio * ratio) } else { 0.0 };
            // Zero where nothing changed, and symmetric in the two pixels that the residual compares: a weight
            // that knew only one of them would correlate its noise with the gradient and shorten the step.
            let change2 = ((still[i] - later[i]) * (still[i] - later[i] - residual[i])).max(0.0);
            weight[i] = tukey * (change2 + f64::EPSILON) / (change2 + standing2 + f64::EPSILON);
            along[i] = gain
                * inverse_z[i]
                * (gradient_x[i] * c.fx * (t.x - u[i] * t.z) + gradient_y[i] * c.fy * (t.y - v[i] * t.z));
        }
        for i in 0..LANES {
            if is_used[i] {
                sums.add([along[i] * x[i], along[i] * y, along[i], value[i]], weight[i], later[i], residual[i]);
            }
        }
    }
}

/// Grey values of a row from `column` on; 0 behind its end.
#[inline(always)]
fn grey_values(image: &ImageView<'_>, column: usize, row: usize) -> Four {
    let pixels = image.row(row).get(column..).unwrap_or(&[]);
    let mut values = [0.0; LANES];
    for (value, &pixel) in values.iter_mut().zip(pixels) {
        *value = f64::from(pixel);
    }
    values
}

/// Values and gradients of an image between its pixels.
struct Samples {
    value: Four,
    gradient_x: Four,
    gradient_y: Four,
}

impl Samples {
    /// Samples positions in pixels whose 4x4 neighbourhood is inside; the others are no longer used.
    #[inline(always)]
    fn read(image: &ImageView<'_>, x_px: Four, y_px: Four, is_used: &mut [bool; LANES]) -> Self {
        // Pixel i is centred at i + 0.5.
        let last = [image.width() as f64 - 2.0, image.height() as f64 - 2.0];
        let [mut fx, mut fy] = [[0.0; LANES]; 2];
        // The first pixels of four rows of the neighbourhood, a byte each.
        let mut rows = [[0u32; LANES]; LANES];
        for i in 0..LANES {
            let (x, y) = (x_px[i] - 0.5, y_px[i] - 0.5);
            is_used[i] &= x >= 1.0 && y >= 1.0 && x < last[0] && y < last[1];
            if !is_used[i] {
                continue;
            }
            let (column, row) = (x as u32, y as u32);
            (fx[i], fy[i]) = (x - f64::from(column), y - f64::from(row));
            let bytes = image.from_pixel(column as usize - 1, row as usize - 1);
            for (k, words) in rows.iter_mut().enumerate() {
                let word = bytes.get(k * image.stride()..).and_then(|bytes| bytes.first_chunk());
                words[i] = u32::from_le_bytes(*word.unwrap_or(&[0; 4]));
            }
        }
        let mut samples = Self { value: [0.0; LANES], gradient_x: [0.0; LANES], gradient_y: [0.0; LANES] };
        for i in 0..LANES {
            let pixel = |row: usize, column: usize| f64::from(rows[row][i] >> (8 * column) & 0xff);
            let mix = |row: usize, column: usize| {
                pixel(row, column) + fx[i] * (pixel(row, column + 1) - pixel(row, column))
            };
            let dx = |row: usize| {
                0.5 * ((pixel(row, 2) - pixel(row, 0)) * (1.0 - fx[i]) + (pixel(row, 3) - pixel(row, 1)) * fx[i])
            };
            let (above, upper, lower, below) = (mix(0, 1), mix(1, 1), mix(2, 1), mix(3, 1));
            samples.value[i] = upper + fy[i] * (lower - upper);
            samples.gradient_x[i] = dx(1) + fy[i] * (dx(2) - dx(1));
            samples.gradient_y[i] = 0.5 * ((lower - above) * (1.0 - fy[i]) + (below - upper) * fy[i]);
        }
        samples
    }
}
