//! The inner loops of Lucas-Kanade: a window of pixels as fixed-point integers.
//!
//! Integers make the sums exact, so that they do not depend on the order in which SIMD lanes are added: the bits are
//! the same on every machine. The bounds that keep 16 and 32 bits from overflowing stand at the constants.

use super::affine::Placement;
use super::lanes::{Kernel, LANES};
use super::resample::sample;
use crate::frame::pyramid::PaddedImage;

/// Side of the tracked window, px. Bouguet 2001 and the paper's supplement: 21.
pub(crate) const WINDOW: usize = 21;

const WINDOW_PIXELS: f64 = (WINDOW * WINDOW) as f64;

/// Fractional bits of a grey value: at most 255 * 2^5 = 8160, and four times that (a Sobel sum) still fits 16 bits.
///
/// A sum of products adds two per lane and row, 42 in all: 42 * 8160 * 4080 < 2^31, so one factor is always a
/// gradient (at most 2040) or a halved grey value (at most 4080).
const GRAY_BITS: i32 = 5;

/// Fractional bits of a gradient in grey values per pixel: at most 127.5 * 2^4 = 2040.
const GRADIENT_BITS: i32 = 4;

/// A Sobel sum is eight times the gradient.
const SOBEL_SHIFT: i32 = GRAY_BITS + 3 - GRADIENT_BITS;

/// Newton steps in pixels from sums of differences and gradients.
const STEP_UNIT: f64 = (1u32 << GRADIENT_BITS) as f64 / (1u32 << GRAY_BITS) as f64;

/// A plane of the window, one row per array; lanes at and beyond [`WINDOW`] are zero.
type Plane = [[i16; LANES]; WINDOW];

/// Columns of a row from which gradients are taken.
const GROWN_LANES: usize = LANES + 2;

/// One in the lanes of the window.
const INSIDE: [i16; LANES] = {
    let mut lanes = [0; LANES];
    let mut i = 0;
    while i < WINDOW {
        lanes[i] = 1;
        i += 1;
    }
    lanes
};

/// Rows of a level from a fractional position on, interpolated bilinearly.
struct Rows<'a, K: Kernel> {
    bytes: &'a [u8],
    stride: usize,
    weight_x: K::Row,
    weight_y: K::Row,
}

impl<'a, K: Kernel> Rows<'a, K> {
    /// Rows that begin `reach` pixels left of and above `center_px`; `None` when that is not in image and margin.
    #[inline(always)]
    fn around(kernel: K, level: &PaddedImage<'a>, center_px: [f32; 2], reach: f32) -> Option<Self> {
        let ([x, wx], [y, wy]) = (split(center_px[0] - 0.5 - reach)?, split(center_px[1] - 0.5 - reach)?);
        let bytes = level.from_pixel(x, y)?;
        Some(Self {
            bytes,
            stride: level.stride(),
            weight_x: kernel.splat(wx as i16),
            weight_y: kernel.splat(wy as i16),
        })
    }

    /// Row `r` of the level, interpolated between columns.
    #[inline(always)]
    fn columns(&self, kernel: K, r: usize) -> Option<K::Row> {
        let row: &[u8; LANES + 1] = self.bytes.get(r * self.stride..)?.first_chunk()?;
        let here = kernel.widen::<GRAY_BITS>(row.first_chunk()?);
        let next = kernel.widen::<GRAY_BITS>(row.last_chunk()?);
        Some(kernel.blend(here, next, self.weight_x))
    }
}

/// Whole part (towards minus infinity) and 15-bit fraction.
#[inline(always)]
fn split(coordinate: f32) -> Option<[i32; 2]> {
    const FARTHEST_PX: f32 = 65536.0;
    if !(-FARTHEST_PX..=FARTHEST_PX).contains(&coordinate) {
        return None;
    }
    let towards_zero = coordinate as i32;
    let whole = if coordinate < towards_zero as f32 { towards_zero - 1 } else { towards_zero };
    let fraction = ((coordinate - whole as f32) * 32768.0) as i32;
    Some([whole, fraction.min(i32::from(i16::MAX))])
}

/// What is searched for: the window's grey values and gradients.
///
/// A change of brightness or contrast is projected out: differences that are proportional to 1 or to the window
/// itself move no estimate.
///
/// # Source
/// Baker & Matthews 2004, part 3 (projecting out appearance variation), with exact integer sums.
pub(crate) struct Template {
    /// Values with one more pixel on each side.
    grown: [[i16; GROWN_LANES]; WINDOW + 2],
    value: Plane,
    gradient_x: Plane,
    gradient_y: Plane,
    /// Grey values without their mean, halved.
    half: Plane,
    /// What the sums of a comparison are corrected with.
    statistics: Statistics,
}

/// Sums over the window and what follows from them.
#[derive(Clone, Copy)]
struct Statistics {
    half_mean: f64,
    half_spread: f64,
    /// Means of the gradients, and their regression on the halved grey values.
    gradient_mean: [f64; 2],
    gradient_gain: [f64; 2],
    /// Gradient matrix after the projection: xx, xy, yy.
    hessian: [f64; 3],
}

/// How a window compares with a template.
pub(crate) struct Comparison {
    /// Newton step that brings the window closer, px; `None` where the gradients span no plane.
    pub(crate) step_px: Option<[f32; 2]>,
    difference_mean: f64,
    /// Covariation of the differences with the halved grey values.
    half_difference: f64,
}

impl Template {
    /// Room for a window: it is kept from one to the next, because clearing and moving it takes longer than filling it.
    pub(crate) const NONE: Self = Self {
        grown: [[0; GROWN_LANES]; WINDOW + 2],
        value: [[0; LANES]; WINDOW],
        gradient_x: [[0; LANES]; WINDOW],
        gradient_y: [[0; LANES]; WINDOW],
        half: [[0; LANES]; WINDOW],
        statistics: Statistics::NONE,
    };

    /// Takes the window around `center_px` of a level; `None` when it leaves image and margin.
    #[inline(always)]
    pub(crate) fn take_around<K: Kernel>(
        &mut self,
        kernel: K,
        level: &PaddedImage<'_>,
        center_px: [f32; 2],
    ) -> Option<()> {
        const REACH: f32 = (WINDOW / 2 + 1) as f32;
        let rows = Rows::around(kernel, level, center_px, REACH)?;
        let mut here = rows.columns(kernel, 0)?;
        for (r, grown) in self.grown.iter_mut().enumerate() {
            let below = rows.columns(kernel, r + 1)?;
            kernel.store(kernel.blend(here, below, rows.weight_y), grown.first_chunk_mut()?);
            here = below;
        }
        self.take_grown(kernel)
    }

    /// Takes the window around the centre of `placement` whose offsets are deformed by its shape; `None` when it leaves
    /// image and margin.
    #[inline(always)]
    pub(crate) fn take_deformed<K: Kernel>(
        &mut self,
        kernel: K,
        level: &PaddedImage<'_>,
        placement: &Placement,
    ) -> Option<()> {
        let mut values = [[0.0f32; GROWN_LANES]; WINDOW + 2];
        sample(level, placement, &mut values)?;
        for (grown, values) in self.grown.iter_mut().zip(&values) {
            for i in 0..GROWN_LANES {
                grown[i] = (values[i] * (1u32 << GRAY_BITS) as f32) as i16;
            }
        }
        self.take_grown(kernel)
    }

    /// Values and gradients from the window with one more pixel on each side.
    #[inline(always)]
    fn take_grown<K: Kernel>(&mut self, kernel: K) -> Option<()> {
        let ones = kernel.load(&INSIDE);
        let inside = kernel.subtract(kernel.splat(0), ones);
        let mut total = kernel.zero();
        for r in 0..WINDOW {
            let at = |row: usize, column: usize| -> Option<K::Row> {
                Some(kernel.load(self.grown.get(r + row)?.get(column..)?.first_chunk()?))
            };
            let dx = |row| Some(kernel.subtract(at(row, 2)?, at(row, 0)?));
            let dy = |column| Some(kernel.subtract(at(2, column)?, at(0, column)?));
            let smooth = |a, b, c| kernel.add(kernel.add(a, c), kernel.add(b, b));
            let sobel_x = smooth(dx(0)?, dx(1)?, dx(2)?);
            let sobel_y = smooth(dy(0)?, dy(1)?, dy(2)?);
            let value = at(1, 1)?;
            total = kernel.add_products(total, value, ones);
            kernel.store(kernel.and(value, inside), &mut self.value[r]);
            kernel.store(kernel.and(kernel.shift_right::<SOBEL_SHIFT>(sobel_x), inside), &mut self.gradient_x[r]);
            kernel.store(kernel.and(kernel.shift_right::<SOBEL_SHIFT>(sobel_y), inside), &mut self.gradient_y[r]);
        }
        let n_pixels = (WINDOW * WINDOW) as i64;
        let mean = kernel.splat(((kernel.total(total) + n_pixels / 2) / n_pixels) as i16);
        for (value, half) in self.value.iter().zip(&mut self.half) {
            let centered = kernel.subtract(kernel.load(value), mean);
            kernel.store(kernel.and(kernel.shift_right::<1>(centered), inside), half);
        }
        self.measure(kernel);
        Some(())
    }

    #[inline(always)]
    fn measure<K: Kernel>(&mut self, kernel: K) {
        let ones = kernel.load(&INSIDE);
        let [mut h, mut gx, mut gy, mut hh, mut hx, mut hy, mut xx, mut xy, mut yy] = [kernel.zero(); 9];
        for r in 0..WINDOW {
            let half = kernel.load(&self.half[r]);
            let (x, y) = (kernel.load(&self.gradient_x[r]), kernel.load(&self.gradient_y[r]));
            h = kernel.add_products(h, half, ones);
            gx = kernel.add_products(gx, x, ones);
            gy = kernel.add_products(gy, y, ones);
            hh = kernel.add_products(hh, half, half);
            hx = kernel.add_products(hx, half, x);
            hy = kernel.add_products(hy, half, y);
            xx = kernel.add_products(xx, x, x);
            xy = kernel.add_products(xy, x, y);
            yy = kernel.add_products(yy, y, y);
        }
        let mean = |sums| kernel.total(sums) as f64 / WINDOW_PIXELS;
        let (half_mean, gradient_mean) = (mean(h), [mean(gx), mean(gy)]);
        let covariation = |sums, mean_a, mean_b| kernel.total(sums) as f64 - WINDOW_PIXELS * mean_a * mean_b;
        let half_spread = covariation(hh, half_mean, half_mean);
        let [mx, my] = gradient_mean;
        let (hx, hy) = (covariation(hx, half_mean, mx), covariation(hy, half_mean, my));
        let gradient_gain = if half_spread > 0.0 { [hx / half_spread, hy / half_spread] } else { [0.0; 2] };
        let [gain_x, gain_y] = gradient_gain;
        let hessian = [
            covariation(xx, mx, mx) - gain_x * hx,
            covariation(xy, mx, my) - gain_x * hy,
            covariation(yy, my, my) - gain_y * hy,
        ];
        self.statistics = Statistics { half_mean, half_spread, gradient_mean, gradient_gain, hessian };
    }

    /// Smallest eigenvalue of the mean gradient matrix, squared grey values per squared pixel.
    #[inline(always)]
    pub(crate) fn min_eigenvalue<K: Kernel>(&self, kernel: K) -> f32 {
        const UNIT: f64 = WINDOW_PIXELS * (1u32 << (2 * GRADIENT_BITS)) as f64;
        let [xx, xy, yy] = self.statistics.hessian.map(|sum| sum / UNIT);
        let half_difference = 0.5 * (xx - yy);
        (0.5 * (xx + yy) - kernel.sqrt(half_difference * half_difference + xy * xy)) as f32
    }

    /// Standard deviation of a position found by this window in its worst direction, level px, when what differs is
    /// white noise and in both windows; `None` when there is nothing but noise.
    ///
    /// Noise makes gradients of its own, which hold nothing.
    #[inline(always)]
    pub(crate) fn sigma_px<K: Kernel>(&self, kernel: K, correlation: f32) -> Option<f32> {
        /// Variance of a Sobel gradient of white noise of variance 1.
        const SOBEL_NOISE: f64 = 12.0 / 64.0;
        const UNIT: f64 = 4.0 / ((1u32 << (2 * GRAY_BITS)) as f64 * WINDOW_PIXELS);
        let variance = self.statistics.half_spread * UNIT;
        let noise = variance * f64::from(1.0 - correlation).max(0.0);
        let signal = f64::from(self.min_eigenvalue(kernel)) - SOBEL_NOISE * noise;
        (signal > 0.0).then(|| kernel.sqrt(2.0 * noise / (WINDOW_PIXELS * signal)) as f32)
    }

    /// Compares the window of `level` around `center_px`; `None` when it leaves image and margin.
    #[inline(always)]
    pub(crate) fn compare<K: Kernel>(
        &self,
        kernel: K,
        level: &PaddedImage<'_>,
        center_px: [f32; 2],
    ) -> Option<Comparison> {
        const REACH: f32 = (WINDOW / 2) as f32;
        let rows = Rows::around(kernel, level, center_px, REACH)?;
        let ones = kernel.load(&INSIDE);
        let [mut d, mut dh, mut dx, mut dy] = [kernel.zero(); 4];
        let mut here = rows.columns(kernel, 0)?;
        for r in 0..WINDOW {
            let below = rows.columns(kernel, r + 1)?;
            let found = kernel.blend(here, below, rows.weight_y);
            here = below;
            let difference = kernel.subtract(found, kernel.load(&self.value[r]));
            d = kernel.add_products(d, difference, ones);
            dh = kernel.add_products(dh, difference, kernel.load(&self.half[r]));
            dx = kernel.add_products(dx, difference, kernel.load(&self.gradient_x[r]));
            dy = kernel.add_products(dy, difference, kernel.load(&self.gradient_y[r]));
        }
        let total = |sums| kernel.total(sums) as f64;
        let statistics = &self.statistics;
        let difference_mean = total(d) / WINDOW_PIXELS;
        let half_difference = total(dh) - total(d) * statistics.half_mean;
        let [[mx, my], [gain_x, gain_y]] = [statistics.gradient_mean, statistics.gradient_gain];
        let bx = total(dx) - total(d) * mx - gain_x * half_difference;
        let by = total(dy) - total(d) * my - gain_y * half_difference;
        let [xx, xy, yy] = statistics.hessian;
        let determinant = xx * yy - xy * xy;
        let step = |numerator: f64| (-STEP_UNIT * numerator / determinant) as f32;
        let step_px = (determinant > 0.0).then(|| [step(yy * bx - xy * by), step(xx * by - xy * bx)]);
        Some(Comparison { step_px, difference_mean, half_difference })
    }

    /// Correlation coefficient with the window of `level` around `center_px`, in [-1, 1]; 0 for a flat window.
    #[inline(always)]
    pub(crate) fn correlation<K: Kernel>(
        &self,
        kernel: K,
        level: &PaddedImage<'_>,
        center_px: [f32; 2],
    ) -> Option<f32> {
        let [spread, found_spread, together] = self.spreads(kernel, level, center_px)?;
        let norm = kernel.sqrt((spread * found_spread).max(0.0));
        Some(if norm > 0.0 { (together / norm).clamp(-1.0, 1.0) as f32 } else { 0.0 })
    }

    /// How many times the contrast of the template the window of `level` around `center_px` has, whatever it shows;
    /// `None` when one of them is flat.
    #[inline(always)]
    pub(crate) fn contrast<K: Kernel>(&self, kernel: K, level: &PaddedImage<'_>, center_px: [f32; 2]) -> Option<f32> {
        let [spread, found_spread, _] = self.spreads(kernel, level, center_px)?;
        (spread > 0.0 && found_spread > 0.0).then(|| kernel.sqrt(found_spread / spread) as f32)
    }

    /// Sums of squares of the template and of the window of `level` around `center_px`, and of their products, all
    /// without means and of halved grey values.
    #[inline(always)]
    fn spreads<K: Kernel>(&self, kernel: K, level: &PaddedImage<'_>, center_px: [f32; 2]) -> Option<[f64; 3]> {
        const REACH: f32 = (WINDOW / 2) as f32;
        let comparison = self.compare(kernel, level, center_px)?;
        let rows = Rows::around(kernel, level, center_px, REACH)?;
        let inside = kernel.subtract(kernel.splat(0), kernel.load(&INSIDE));
        let mut squares = kernel.zero();
        let mut here = rows.columns(kernel, 0)?;
        for r in 0..WINDOW {
            let below = rows.columns(kernel, r + 1)?;
            let found = kernel.blend(here, below, rows.weight_y);
            here = below;
            let difference = kernel.subtract(found, kernel.load(&self.value[r]));
            let half = kernel.and(kernel.shift_right::<1>(difference), inside);
            squares = kernel.add_products(squares, half, half);
        }
        // In halved units the window is h + d / 2, where h is the template and d the difference.
        let half_mean = 0.5 * comparison.difference_mean;
        let difference_spread = kernel.total(squares) as f64 - WINDOW_PIXELS * half_mean * half_mean;
        let spread = self.statistics.half_spread;
        let together = spread + 0.5 * comparison.half_difference;
        let found_spread = spread + comparison.half_difference + difference_spread;
        Some([spread, found_spread, together])
    }
}

impl Statistics {
    const NONE: Self =
        Self { half_mean: 0.0, half_spread: 0.0, gradient_mean: [0.0; 2], gradient_gain: [0.0; 2], hessian: [0.0; 3] };
}
