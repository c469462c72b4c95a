//! Structural similarity and its gradient.
//!
//! Windows reach over the border onto zeros, as in the reference losses of the field. A window sum is a product of
//! a row sum and a column sum, and is its own adjoint, so the gradient is three more window sums.

use super::lane::{Lane, Wide, each};
use super::simd::Dispatch;
use super::splats::take_front;
use crate::pool::Pool;
use crate::splat::kernel_constants::{
    MAX_IMAGE_SIDE_PX, SSIM_C1 as C1, SSIM_C2 as C2, SSIM_RADIUS, SSIM_WEIGHTS as WEIGHTS,
};
use pulp::{Simd, WithSimd};

/// Pixels from the middle of a window to its border.
const RADIUS: usize = SSIM_RADIUS as usize;
/// Pixels along a window.
const TAPS: usize = WEIGHTS.len();
const _: () = assert!(TAPS == 2 * RADIUS + 1, "a window has its middle and a radius on both sides");

/// Planes of scratch that [`add_ssim`] needs, each as large as the picture.
pub const SSIM_PLANES: usize = N_SUMS + N_DERIVATIVES;
/// Window sums of x, y, xx, yy, xy.
const N_SUMS: usize = 5;
/// Derivatives with respect to the window sums of x, xx, xy.
const N_DERIVATIVES: usize = 3;
/// Most jobs of a pass; fixed, so that sums do not depend on the thread count.
const MAX_BANDS: usize = 32;

/// One channel of two pictures.
#[derive(Clone, Copy)]
pub struct Channel<'a> {
    /// Width, px.
    pub width: usize,
    /// The picture that the gradient is for.
    pub x: &'a [f32],
    /// The picture to compare with.
    pub y: &'a [f32],
}

/// Adds `weight * d(sum of SSIM over the pixels)/dx` to `grad` and returns that sum.
///
/// # Source
/// Wang et al. 2004, eq. 13; derivative: own.
pub fn add_ssim(
    pool: &Pool,
    dispatch: Dispatch,
    channel: Channel<'_>,
    weight: f32,
    scratch: &mut [f32],
    grad: &mut [f32],
) -> f64 {
    let n = channel.x.len();
    let (sums, derivatives) = scratch[..SSIM_PLANES * n].split_at_mut(N_SUMS * n);
    for_bands(pool, channel, sums, N_SUMS, |band| dispatch.run(SumRows(channel, band)));
    let sums = &*sums;
    let total = for_bands(pool, channel, derivatives, N_DERIVATIVES, |band| dispatch.run(Compare(channel, sums, band)));
    let derivatives = &*derivatives;
    for_bands(pool, channel, grad, 1, |band| dispatch.run(Collect(channel, derivatives, weight, band)));
    total
}

/// Some rows of some planes.
struct Band<'a> {
    first_row: usize,
    n_rows: usize,
    planes: heapless::Vec<&'a mut [f32], N_SUMS>,
    sum: f64,
}

/// Runs `task` on bands of rows of `n_planes` planes stored one after the other; returns the sum of their sums.
fn for_bands(
    pool: &Pool,
    channel: Channel<'_>,
    planes: &mut [f32],
    n_planes: usize,
    task: impl Fn(&mut Band<'_>) + Sync,
) -> f64 {
    let height = channel.x.len() / channel.width;
    let band_rows = height.div_ceil(MAX_BANDS);
    let mut bands = heapless::Vec::<Band<'_>, MAX_BANDS>::new();
    for first_row in (0..height).step_by(band_rows) {
        let n_rows = band_rows.min(height - first_row);
        let band = Band { first_row, n_rows, planes: heapless::Vec::new(), sum: 0.0 };
        if bands.push(band).is_err() {
            unreachable!("rows are divided by MAX_BANDS");
        }
    }
    for mut plane in planes.chunks_exact_mut(channel.x.len()).take(n_planes) {
        for band in &mut bands {
            let rows = take_front(&mut plane, band.n_rows * channel.width);
            if band.planes.push(rows).is_err() {
                unreachable!("there are at most N_SUMS planes");
            }
        }
    }
    pool.for_each(&mut bands, |_, band| task(band));
    bands.iter().map(|band| band.sum).sum()
}

/// A row of pixels with zeros on both sides, so that windows need no border case.
struct Padded([f32; RADIUS + MAX_IMAGE_SIDE_PX as usize + RADIUS + SPARE]);

/// Lanes that a vector may read beyond the last window.
const SPARE: usize = 16;

impl Padded {
    fn new() -> Self {
        Self([0.0; RADIUS + MAX_IMAGE_SIDE_PX as usize + RADIUS + SPARE])
    }

    fn set(&mut self, row: &[f32]) {
        self.0[RADIUS..RADIUS + row.len()].copy_from_slice(row);
    }

    fn row_mut(&mut self, width: usize) -> &mut [f32] {
        &mut self.0[RADIUS..RADIUS + width]
    }

    /// Pixels `x + tap - RADIUS` from tap 0 on.
    #[inline(always)]
    fn window(&self, x: usize) -> &[f32] {
        &self.0[x..x + TAPS - 1 + SPARE]
    }
}

/// First pass: row sums of x, y, xx, yy, xy.
struct SumRows<'c, 'b, 'a>(Channel<'c>, &'b mut Band<'a>);

impl WithSimd for SumRows<'_, '_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self(channel, band) = self;
        let width = channel.width;
        let (mut row_x, mut row_y) = (Padded::new(), Padded::new());
        for i in 0..band.n_rows {
            let row = (band.first_row + i) * width..(band.first_row + i + 1) * width;
            row_x.set(&channel.x[row.clone()]);
            row_y.set(&channel.y[row]);
            for at in (0..width).step_by(S::F32_LANES) {
                let mut sums = [Wide::splat(simd, 0.0); N_SUMS];
                let (window_x, window_y) = (row_x.window(at), row_y.window(at));
                for (tap, &weight) in WEIGHTS.iter().enumerate() {
                    let weight = Wide::splat(simd, weight);
                    let (x, y) = (Wide::load(simd, &window_x[tap..]), Wide::load(simd, &window_y[tap..]));
                    let (wx, wy) = (weight * x, weight * y);
                    sums[0] = sums[0] + wx;
                    sums[1] = sums[1] + wy;
                    sums[2] = wx.mul_add(x, sums[2]);
                    sums[3] = wy.mul_add(y, sums[3]);
                    sums[4] = wx.mul_add(y, sums[4]);
                }
                let pixels = i * width + at..i * width + (at + S::F32_LANES).min(width);
                for p in 0..N_SUMS {
                    sums[p].store(&mut band.planes[p][pixels.clone()]);
                }
            }
        }
    }
}

/// Weighted sum over a column of `plane` around `row`, at the lanes from column `at` on.
#[inline(always)]
fn column_sum<S: Simd>(simd: S, plane: &[f32], width: usize, row: usize, at: usize) -> Wide<S> {
    let height = plane.len() / width;
    let mut sum = Wide::splat(simd, 0.0);
    for r in row.saturating_sub(RADIUS)..(row + RADIUS + 1).min(height) {
        let weight = Wide::splat(simd, WEIGHTS[r + RADIUS - row]);
        sum = weight.mul_add(Wide::load(simd, &plane[r * width + at..(r + 1) * width]), sum);
    }
    sum
}

/// Second pass: column sums, the similarity, and row sums of its derivatives.
struct Compare<'c, 'b, 'a>(Channel<'c>, &'c [f32], &'b mut Band<'a>);

impl WithSimd for Compare<'_, '_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self(channel, sums, band) = self;
        let width = channel.width;
        let n = channel.x.len();
        let mut rows = [const { Padded([0.0; RADIUS + MAX_IMAGE_SIDE_PX as usize + RADIUS + SPARE]) }; N_DERIVATIVES];
        let mut values = Padded::new();
        for i in 0..band.n_rows {
            let row = band.first_row + i;
            for at in (0..width).step_by(S::F32_LANES) {
                let mut window = [Wide::splat(simd, 0.0); N_SUMS];
                for p in 0..N_SUMS {
                    window[p] = column_sum(simd, &sums[p * n..(p + 1) * n], width, row, at);
                }
                let (value, derivatives) = similarity(&window);
                let end = (at + S::F32_LANES).min(width);
                value.store(&mut values.row_mut(width)[at..end]);
                for p in 0..N_DERIVATIVES {
                    derivatives[p].store(&mut rows[p].row_mut(width)[at..end]);
                }
            }
            band.sum += values.row_mut(width).iter().map(|&v| f64::from(v)).sum::<f64>();
            for (plane, row) in band.planes.iter_mut().zip(&rows) {
                for at in (0..width).step_by(S::F32_LANES) {
                    let window = row.window(at);
                    let mut sum = Wide::splat(simd, 0.0);
                    for (tap, &weight) in WEIGHTS.iter().enumerate() {
                        sum = Wide::splat(simd, weight).mul_add(Wide::load(simd, &window[tap..]), sum);
                    }
                    sum.store(&mut plane[i * width + at..i * width + (at + S::F32_LANES).min(width)]);
                }
            }
        }
    }
}

/// SSIM from the window sums of x, y, xx, yy, xy, and its derivatives with respect to those of x, xx, xy.
#[inline(always)]
fn similarity<L: Lane>(window: &[L; N_SUMS]) -> (L, [L; N_DERIVATIVES]) {
    let [mean_x, mean_y, xx, yy, xy] = *window;
    let (c1, c2) = (mean_x.constant(C1), mean_x.constant(C2));
    let two = mean_x.constant(2.0);
    let covariance = xy - mean_x * mean_y;
    let variances = (xx - mean_x * mean_x) + (yy - mean_y * mean_y);
    let mean_top = two * mean_x * mean_y + c1;
    let mean_bottom = mean_x * mean_x + mean_y * mean_y + c1;
    let variance_top = two * covariance + c2;
    let variance_bottom = variances + c2;
    let inverse = mean_x.constant(1.0) / (mean_bottom * variance_bottom);
    let value = mean_top * variance_top * inverse;
    let by_covariance = two * mean_top * inverse;
    let by_variance = -value / variance_bottom;
    let by_mean = two * mean_y * variance_top * inverse - two * mean_x * value / mean_bottom;
    // The variance and covariance contain the mean as well.
    let by_mean = by_mean - two * mean_x * by_variance - mean_y * by_covariance;
    (value, [by_mean, by_variance, by_covariance])
}

/// Third pass: column sums of the derivatives, collected at every pixel.
struct Collect<'c, 'b, 'a>(Channel<'c>, &'c [f32], f32, &'b mut Band<'a>);

impl WithSimd for Collect<'_, '_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self(channel, derivatives, weight, band) = self;
        let width = channel.width;
        let n = channel.x.len();
        let weight = Wide::splat(simd, weight);
        let Some(grad) = band.planes.first_mut() else { return };
        for i in 0..band.n_rows {
            let row = band.first_row + i;
            for at in (0..width).step_by(S::F32_LANES) {
                let [by_x, by_xx, by_xy] =
                    each!(p in 3 => column_sum(simd, &derivatives[p * n..(p + 1) * n], width, row, at));
                let end = (at + S::F32_LANES).min(width);
                let x = Wide::load(simd, &channel.x[row * width + at..row * width + end]);
                let y = Wide::load(simd, &channel.y[row * width + at..row * width + end]);
                let by_pixel = y.mul_add(by_xy, by_x + x.constant(2.0) * x * by_xx);
                let grad = &mut grad[i * width + at..i * width + end];
                weight.mul_add(by_pixel, Wide::load(simd, grad)).store(grad);
            }
        }
    }
}
