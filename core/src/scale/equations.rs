//! The normal equations of the road's alignment, four pixels at a time.

use super::ground_plane::RoadPair;
use super::strip::{Alignment, Normal5, Strip, Vector5};
use super::tiles::RoadMask;
use crate::features::SimdLevel;
use crate::features::doubles::{Doubles, FOUR, all_of, blend};
use crate::features::lanes::{Kernel, KernelTask};
use crate::frame::ImageView;
use nalgebra::Vector3;

/// Width of Tukey's kernel in standard deviations (95 % efficiency).
const TUKEY_SIGMAS: f64 = 4.685;
/// Standard deviation over mean absolute deviation of Gaussian noise.
const SIGMA_PER_MEAN_ABSOLUTE: f64 = 1.2533;
/// Camera noise and rounding, grey values: a residual is never weighed as if it were smaller.
const MIN_NOISE_GREY: f64 = 1.0;

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
    let mut sums = Sums { sums: [0.0; N_SUMS], n_pixels: 0 };
    let rotation = *view.pair.earlier_from_later.rotation.to_rotation_matrix().matrix();
    let rotation_rows = [0, 1, 2].map(|k: usize| rotation.row(k).transpose());
    let translation = view.pair.earlier_from_later.translation.vector;
    simd.run(Scan { view, alignment, noise, rotation_rows, translation, sums: &mut sums });
    sums.finish()
}

/// Sums over the pixels, as [`products`] orders them.
const N_SUMS: usize = 24;

/// Weighted sums of the products of the row (d0, d1, d2, value, 1) of the Jacobian, the residual and the later grey value.
struct Sums {
    sums: [f64; N_SUMS],
    n_pixels: usize,
}

impl Sums {
    fn finish(&self) -> (Normal5, Vector5, Fit) {
        #[rustfmt::skip]
        let [
            h00, h10, h20, h30, h11, h21, h31, h22, h32, h33, h40, h41, h42, h43,
            g0, g1, g2, g3, n, later, residual, absolute, value_later, later_later,
        ] = self.sums;
        #[rustfmt::skip]
        let hessian = Normal5::new(
            h00, 0.0, 0.0, 0.0, 0.0,
            h10, h11, 0.0, 0.0, 0.0,
            h20, h21, h22, 0.0, 0.0,
            h30, h31, h32, h33, 0.0,
            h40, h41, h42, h43, n,
        );
        let covariance = value_later - h43 * later / n;
        let (of_value, of_later) = (h33 - h43 * h43 / n, later_later - later * later / n);
        let correlation = covariance / libm::sqrt(of_value * of_later).max(f64::MIN_POSITIVE);
        let mean_absolute = absolute / n.max(f64::MIN_POSITIVE);
        let noise = (SIGMA_PER_MEAN_ABSOLUTE * mean_absolute).max(MIN_NOISE_GREY);
        (hessian, Vector5::new(g0, g1, g2, g3, residual), Fit { n_pixels: self.n_pixels, correlation, noise })
    }
}

struct Scan<'a, 'm, 's> {
    view: &'s RoadView<'a, 'm, 's>,
    alignment: &'s Alignment,
    noise: f64,
    rotation_rows: [Vector3<f64>; 3],
    translation: Vector3<f64>,
    sums: &'s mut Sums,
}

impl KernelTask for Scan<'_, '_, '_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let RoadView { strip, mask, .. } = *self.view;
        let mut groups = [kernel.all(0.0); N_SUMS / FOUR];
        let mut n_pixels = 0;
        for row in 0..strip.later.height() {
            let y = strip.y_z1(row);
            let Some((first, end)) = strip.columns(y) else { continue };
            let excluded = mask.row(y);
            for column in (first..end).step_by(FOUR) {
                let Some((is_used, terms)) = self.terms(kernel, [column, row], end, excluded) else { continue };
                for i in 0..FOUR {
                    if is_used[i] {
                        n_pixels += 1;
                        for (group, terms) in groups.iter_mut().zip(&terms) {
                            *group = *group + terms[i];
                        }
                    }
                }
            }
        }
        self.sums.n_pixels = n_pixels;
        for (sums, group) in self.sums.sums.chunks_exact_mut(FOUR).zip(groups) {
            sums.copy_from_slice(&group.values());
        }
    }
}

/// What four pixels add to the sums, four sums and a pixel at a time.
type Terms<D> = [[D; FOUR]; N_SUMS / FOUR];

impl Scan<'_, '_, '_> {
    /// What the pixels of a row from `column` on add, as far as they lie before `end` and are used; `None` when none is.
    #[inline(always)]
    fn terms<K: Kernel>(
        &self,
        kernel: K,
        [column, row]: [usize; 2],
        end: usize,
        excluded: u128,
    ) -> Option<([bool; FOUR], Terms<K::Doubles>)> {
        let (strip, c, alignment) = (self.view.strip, &self.view.strip.camera, self.alignment);
        let one = kernel.all(1.0);
        let columns = kernel.all(column as f64) + kernel.doubles([0.0, 1.0, 2.0, 3.0]);
        let x = (columns + kernel.all(0.5) - kernel.all(c.cx)) / kernel.all(c.fx);
        let y = kernel.all(strip.y_z1(row));
        let [tx, ty, tz] = all_of(kernel, &self.translation);
        let shift = on_ray(kernel, &alignment.plane, x, y);
        let qx = on_ray(kernel, &self.rotation_rows[0], x, y) + tx * shift;
        let qy = on_ray(kernel, &self.rotation_rows[1], x, y) + ty * shift;
        let qz = on_ray(kernel, &self.rotation_rows[2], x, y) + tz * shift;
        let inverse_z = one / qz;
        let (u, v) = (qx * inverse_z, qy * inverse_z);
        let (fx, fy) = (kernel.all(c.fx), kernel.all(c.fy));
        let mut is_used = [true; FOUR];
        if column + FOUR > end || excluded != 0 {
            for (i, (is_used, x)) in is_used.iter_mut().zip(x.values()).enumerate() {
                *is_used = column + i < end && !self.view.mask.excludes(excluded, x);
            }
        }
        let pixel = [fx * u + kernel.all(c.cx), fy * v + kernel.all(c.cy)];
        let samples = Samples::read(kernel, &strip.earlier, pixel, &mut is_used);
        if is_used == [false; FOUR] {
            return None;
        }
        let Samples { value, gradient_x, gradient_y } = samples;
        let later = grey_values(kernel, &strip.later, column, row);
        let still = grey_values(kernel, &strip.earlier, column, row);
        let gain = kernel.all(alignment.gain);
        let residual = gain * value + kernel.all(alignment.bias) - later;
        let weight = self.weight(kernel, residual, later, still);
        let along = gain * inverse_z * (gradient_x * fx * (tx - u * tz) + gradient_y * fy * (ty - v * tz));
        let mut terms = products([along * x, along * y, along, value], weight, residual, later);
        for four in &mut terms {
            *four = Doubles::transpose(*four);
        }
        Some((is_used, terms))
    }

    /// Weights of residuals between the images; `still` is what the earlier one shows where the later pixel is.
    #[inline(always)]
    fn weight<K: Kernel>(&self, kernel: K, residual: K::Doubles, later: K::Doubles, still: K::Doubles) -> K::Doubles {
        let (zero, one, epsilon) = (kernel.all(0.0), kernel.all(1.0), kernel.all(f64::EPSILON));
        let ratio = residual / kernel.all(TUKEY_SIGMAS * self.noise);
        let complement = one - ratio * ratio;
        let tukey = ratio.abs().if_less(one, complement * complement, zero);
        // Zero where nothing changed, and symmetric in the two pixels that the residual compares: a weight
        // that knew only one of them would correlate its noise with the gradient and shorten the step.
        let change = still - later;
        let change2 = (change * (change - residual)).at_least(zero);
        let standing_grey = self.view.strip.settings.standing_grey;
        tukey * (change2 + epsilon) / (change2 + kernel.all(standing_grey * standing_grey) + epsilon)
    }
}

/// What four pixels add to the sums, a sum for all pixels at a time.
#[inline(always)]
fn products<D: Doubles>(row: [D; FOUR], weight: D, residual: D, later: D) -> Terms<D> {
    let [d0, d1, d2, value] = row;
    let [w0, w1, w2, w3] = [weight * d0, weight * d1, weight * d2, weight * value];
    let (error, weighted_later) = (weight * residual, weight * later);
    [
        [w0 * d0, w0 * d1, w0 * d2, w0 * value],
        [w1 * d1, w1 * d2, w1 * value, w2 * d2],
        [w2 * value, w3 * value, w0, w1],
        [w2, w3, error * d0, error * d1],
        [error * d2, error * value, weight, weighted_later],
        [error, weight * residual.abs(), w3 * later, weighted_later * later],
    ]
}

/// Grey values of a row from `column` on; 0 behind its end.
#[inline(always)]
fn grey_values<K: Kernel>(kernel: K, image: &ImageView<'_>, column: usize, row: usize) -> K::Doubles {
    let pixels = image.row(row).get(column..).unwrap_or(&[]);
    let mut words = [0; FOUR];
    for (word, &pixel) in words.iter_mut().zip(pixels) {
        *word = pixel.into();
    }
    kernel.bytes::<0>(words)
}

/// The bytes of words, lowest first.
#[inline(always)]
fn pixels<K: Kernel>(kernel: K, words: [u32; FOUR]) -> [K::Doubles; 4] {
    [kernel.bytes::<0>(words), kernel.bytes::<8>(words), kernel.bytes::<16>(words), kernel.bytes::<24>(words)]
}

/// Products of a row with the rays (x, y, 1).
#[inline(always)]
fn on_ray<K: Kernel>(kernel: K, row: &Vector3<f64>, x: K::Doubles, y: K::Doubles) -> K::Doubles {
    kernel.all(row.x) * x + kernel.all(row.y) * y + kernel.all(row.z)
}

/// Values and gradients of an image between its pixels.
struct Samples<D> {
    value: D,
    gradient_x: D,
    gradient_y: D,
}

impl<D: Doubles> Samples<D> {
    /// Samples positions in pixels whose 4x4 neighbourhood is inside; the others are no longer used.
    #[inline(always)]
    fn read<K: Kernel<Doubles = D>>(
        kernel: K,
        image: &ImageView<'_>,
        [x_px, y_px]: [D; 2],
        is_used: &mut [bool; FOUR],
    ) -> Self {
        // Pixel i is centred at i + 0.5.
        let half = kernel.all(0.5);
        let (x, y) = ((x_px - half).values(), (y_px - half).values());
        let last = [image.width() as f64 - 2.0, image.height() as f64 - 2.0];
        let [mut fx, mut fy] = [[0.0; FOUR]; 2];
        // Four pixels of four rows of the neighbourhood, a byte each.
        let mut rows = [[0u32; FOUR]; 4];
        for i in 0..FOUR {
            is_used[i] &= (x[i] >= 1.0) & (y[i] >= 1.0) & (x[i] < last[0]) & (y[i] < last[1]);
            if !is_used[i] {
                continue;
            }
            let (column, row) = (x[i] as u32, y[i] as u32);
            (fx[i], fy[i]) = (x[i] - f64::from(column), y[i] - f64::from(row));
            let bytes = image.bytes_from(column as usize - 1, row as usize - 1);
            for (k, words) in rows.iter_mut().enumerate() {
                let word = bytes.get(k * image.stride()..).and_then(|bytes| bytes.first_chunk());
                words[i] = u32::from_le_bytes(*word.unwrap_or(&[0; 4]));
            }
        }
        let (fx, fy, one) = (kernel.doubles(fx), kernel.doubles(fy), kernel.all(1.0));
        let [pixels0, pixels1] = [pixels(kernel, rows[0]), pixels(kernel, rows[1])];
        let [pixels2, pixels3] = [pixels(kernel, rows[2]), pixels(kernel, rows[3])];
        let (above, upper) = (blend(pixels0[1], pixels0[2], fx), blend(pixels1[1], pixels1[2], fx));
        let (lower, below) = (blend(pixels2[1], pixels2[2], fx), blend(pixels3[1], pixels3[2], fx));
        let slope_upper = half * ((pixels1[2] - pixels1[0]) * (one - fx) + (pixels1[3] - pixels1[1]) * fx);
        let slope_lower = half * ((pixels2[2] - pixels2[0]) * (one - fx) + (pixels2[3] - pixels2[1]) * fx);
        Self {
            value: blend(upper, lower, fy),
            gradient_x: blend(slope_upper, slope_lower, fy),
            gradient_y: half * ((lower - above) * (one - fy) + (below - upper) * fy),
        }
    }
}
