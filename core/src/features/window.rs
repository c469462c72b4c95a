//! The inner loops of Lucas-Kanade: a window of pixels as fixed-point integers.
//!
//! Integers make the sums exact, so that they do not depend on the order in which SIMD lanes are added:
//! the bits are the same on every machine. Every bound that keeps `i16` and `i32` from overflowing is at its constant.

use crate::frame::pyramid::PaddedImage;

/// Side of the tracked window, px. Bouguet 2001 and the paper's supplement: 21.
pub(super) const WINDOW: usize = 21;

/// Pixels of the window.
pub(super) const WINDOW_PIXELS: i64 = (WINDOW * WINDOW) as i64;

/// Window columns rounded up to whole SIMD registers.
const LANES: usize = 32;

/// Fractional bits of a grey value: 255 * 2^5 = 8160, and four times that still fits `i16` (Sobel sum).
const GRAY_BITS: u32 = 5;

/// Fractional bits of a gradient in grey values per pixel: at most 127.5 * 2^4 = 2040.
const GRADIENT_BITS: u32 = 4;

/// Bound on projected gradients; two products per `i32` lane and row: 21 * 2 * 2047 * 8160 < 2^30.
const GRADIENT_LIMIT: i32 = 2047;

/// Fractional bits of the part of a gradient that looks like a gain; 2^3 * 2^12 * 8160 + 2^12 * 2041 < 2^31.
const GAIN_BITS: u32 = 12;

/// Largest such part that is taken out.
const GAIN_LIMIT: i64 = 8 << GAIN_BITS;

/// A plane of the window, one row per array, lanes at and beyond [`WINDOW`] without meaning.
type Plane = [[i16; LANES]; WINDOW];

/// Where a window starts: whole pixel and the bilinear weight of the pixel after it, in units of 2^-15.
#[derive(Clone, Copy)]
struct Origin {
    pixel: [i32; 2],
    weight: [i16; 2],
}

impl Origin {
    /// Window centred at `center_px` with `reach` pixels on each side; `None` when that is not a number.
    #[inline(always)]
    fn around(center_px: [f32; 2], reach: f32) -> Option<Self> {
        let [x, y] = center_px.map(|c| c - 0.5 - reach);
        let ([px, wx], [py, wy]) = (split(x)?, split(y)?);
        Some(Self { pixel: [px, py], weight: [wx as i16, wy as i16] })
    }
}

/// Whole part (towards minus infinity) and 15-bit fraction.
#[inline(always)]
fn split(coordinate: f32) -> Option<[i32; 2]> {
    const FARTHEST_PX: f32 = 65536.0;
    if !(-FARTHEST_PX..=FARTHEST_PX).contains(&coordinate) {
        return None;
    }
    let whole = libm::floorf(coordinate);
    let fraction = ((coordinate - whole) * 32768.0) as i32;
    Some([whole as i32, fraction.min(i32::from(i16::MAX))])
}

/// `a * b` rounded, with `b` in units of 2^-15; one instruction on x86 and ARM.
#[inline(always)]
fn scale_q15(a: i16, b: i16) -> i16 {
    ((((i32::from(a) * i32::from(b)) >> 14) + 1) >> 1) as i16
}

/// One row, interpolated between columns.
#[inline(always)]
fn blend_columns(row: &[u8; LANES + 1], weight: i16) -> [i16; LANES] {
    let mut out = [0; LANES];
    for i in 0..LANES {
        let here = i16::from(row[i]) << GRAY_BITS;
        let next = i16::from(row[i + 1]) << GRAY_BITS;
        out[i] = here + scale_q15(next - here, weight);
    }
    out
}

/// Two rows, interpolated between them.
#[inline(always)]
fn blend_rows(here: &[i16; LANES], below: &[i16; LANES], weight: i16) -> [i16; LANES] {
    let mut out = [0; LANES];
    for i in 0..LANES {
        out[i] = here[i] + scale_q15(below[i] - here[i], weight);
    }
    out
}

#[inline(always)]
fn pixels_of_row(bytes: &[u8], start: usize) -> Option<&[u8; LANES + 1]> {
    bytes.get(start..start + LANES + 1)?.try_into().ok()
}

/// Calls `take(row, values)` for `n_rows` interpolated rows; `None` when the window leaves image and margin.
#[inline(always)]
fn for_each_row(
    level: &PaddedImage<'_>,
    origin: Origin,
    n_rows: usize,
    mut take: impl FnMut(usize, &[i16; LANES]),
) -> Option<()> {
    let [x, y] = origin.pixel;
    let bytes = level.from_pixel(x, y)?;
    let stride = level.stride();
    let mut here = blend_columns(pixels_of_row(bytes, 0)?, origin.weight[0]);
    for r in 0..n_rows {
        let below = blend_columns(pixels_of_row(bytes, (r + 1) * stride)?, origin.weight[0]);
        take(r, &blend_rows(&here, &below, origin.weight[1]));
        here = below;
    }
    Some(())
}

/// What is searched for: the window's grey values and gradients.
///
/// The gradients are stripped of what a change of brightness or contrast could explain (projected onto the
/// complement of `{1, window}`), so that such a change does not move the estimate and costs nothing per iteration.
///
/// # Source
/// Baker & Matthews 2004, part 3 (projecting out appearance variation), for a linear model with two images.
pub(super) struct Template {
    value: Plane,
    gradient_x: Plane,
    gradient_y: Plane,
    /// Sums of squares and products of the projected gradients: xx, xy, yy.
    hessian: [i64; 3],
    /// Mean grey value in fixed point, and the sum of squared differences from it.
    mean: i64,
    spread: i64,
}

impl Template {
    /// Window around `center_px` of a level; `None` when it leaves image and margin.
    #[inline(always)]
    pub(super) fn around(level: &PaddedImage<'_>, center_px: [f32; 2]) -> Option<Self> {
        const REACH: f32 = (WINDOW / 2 + 1) as f32;
        let mut grown = [[0i16; LANES]; WINDOW + 2];
        for_each_row(level, Origin::around(center_px, REACH)?, WINDOW + 2, |r, values| grown[r] = *values)?;

        let mut template = Self {
            value: [[0; LANES]; WINDOW],
            gradient_x: [[0; LANES]; WINDOW],
            gradient_y: [[0; LANES]; WINDOW],
            hessian: [0; 3],
            mean: 0,
            spread: 0,
        };
        for r in 0..WINDOW {
            let (above, here, below) = (&grown[r], &grown[r + 1], &grown[r + 2]);
            for i in 0..WINDOW {
                template.value[r][i] = here[i + 1];
                let dx = |row: &[i16; LANES]| row[i + 2] - row[i];
                let sx = dx(above) + 2 * dx(here) + dx(below);
                let dy = |i: usize| below[i] - above[i];
                let sy = dy(i) + 2 * dy(i + 1) + dy(i + 2);
                template.gradient_x[r][i] = sx >> (GRAY_BITS + 3 - GRADIENT_BITS);
                template.gradient_y[r][i] = sy >> (GRAY_BITS + 3 - GRADIENT_BITS);
            }
        }
        template.measure_values();
        let (mean, spread) = (template.mean, template.spread);
        project_out(&template.value, mean, spread, &mut template.gradient_x);
        project_out(&template.value, mean, spread, &mut template.gradient_y);
        template.hessian = [
            sum_of_products(&template.gradient_x, &template.gradient_x),
            sum_of_products(&template.gradient_x, &template.gradient_y),
            sum_of_products(&template.gradient_y, &template.gradient_y),
        ];
        Some(template)
    }

    #[inline(always)]
    fn measure_values(&mut self) {
        let sum: i64 = self.value.iter().map(|row| row.iter().map(|&v| i32::from(v)).sum::<i32>()).map(i64::from).sum();
        self.mean = (sum + WINDOW_PIXELS / 2) / WINDOW_PIXELS;
        let mean = self.mean as i16;
        for row in &self.value {
            let mut squares = 0i32;
            for &v in &row[..WINDOW] {
                squares += i32::from(v - mean) * i32::from(v - mean);
            }
            self.spread += i64::from(squares);
        }
    }

    /// Smallest eigenvalue of the mean gradient matrix, squared grey values per squared pixel.
    #[inline(always)]
    pub(super) fn min_eigenvalue(&self) -> f32 {
        let unit = (WINDOW_PIXELS << (2 * GRADIENT_BITS)) as f64;
        let [xx, xy, yy] = self.hessian.map(|sum| sum as f64 / unit);
        let half_difference = 0.5 * (xx - yy);
        (0.5 * (xx + yy) - libm::sqrt(half_difference * half_difference + xy * xy)) as f32
    }

    /// Newton step that brings a window of `level` around `center_px` closer to this template, px.
    /// `None` when the window leaves image and margin or the gradients span no plane.
    #[inline(always)]
    pub(super) fn step_px(&self, level: &PaddedImage<'_>, center_px: [f32; 2]) -> Option<[f32; 2]> {
        const REACH: f32 = (WINDOW / 2) as f32;
        let mut sums_x = [0i32; LANES / 2];
        let mut sums_y = [0i32; LANES / 2];
        for_each_row(level, Origin::around(center_px, REACH)?, WINDOW, |r, values| {
            let mut difference = [0i16; LANES];
            for i in 0..LANES {
                difference[i] = values[i] - self.value[r][i];
            }
            add_products(&difference, &self.gradient_x[r], &mut sums_x);
            add_products(&difference, &self.gradient_y[r], &mut sums_y);
        })?;
        let [bx, by] = [sums_x, sums_y].map(|sums| sums.iter().map(|&s| i64::from(s)).sum::<i64>() as f64);
        let [xx, xy, yy] = self.hessian.map(|sum| sum as f64);
        let determinant = xx * yy - xy * xy;
        if determinant <= 0.0 {
            return None;
        }
        const UNIT: f64 = (1u32 << GRADIENT_BITS) as f64 / (1u32 << GRAY_BITS) as f64;
        let step = |numerator: f64| (-UNIT * numerator / determinant) as f32;
        Some([step(yy * bx - xy * by), step(xx * by - xy * bx)])
    }

    /// Correlation coefficient of this template with the window of `level` around `center_px`, in [-1, 1].
    #[inline(always)]
    pub(super) fn correlation(&self, level: &PaddedImage<'_>, center_px: [f32; 2]) -> Option<f32> {
        const REACH: f32 = (WINDOW / 2) as f32;
        let (mut sum, mut squares, mut products) = (0i64, 0i64, 0i64);
        let mean = self.mean as i16;
        for_each_row(level, Origin::around(center_px, REACH)?, WINDOW, |r, values| {
            let (mut row_sum, mut row_squares, mut row_products) = (0i32, 0i32, 0i32);
            for (&value, &sought) in values[..WINDOW].iter().zip(&self.value[r]) {
                let found = i32::from(value - mean);
                row_sum += found;
                row_squares += found * found;
                row_products += found * i32::from(sought - mean);
            }
            sum += i64::from(row_sum);
            squares += i64::from(row_squares);
            products += i64::from(row_products);
        })?;
        let found_spread = squares as f64 - (sum * sum) as f64 / WINDOW_PIXELS as f64;
        let norm = libm::sqrt(found_spread * self.spread as f64);
        Some(if norm > 0.0 { (products as f64 / norm) as f32 } else { 0.0 })
    }
}

/// `sums[k] += a[2k] b[2k] + a[2k + 1] b[2k + 1]`; one instruction per register on x86.
#[inline(always)]
fn add_products(a: &[i16; LANES], b: &[i16; LANES], sums: &mut [i32; LANES / 2]) {
    for k in 0..LANES / 2 {
        let even = i32::from(a[2 * k]) * i32::from(b[2 * k]);
        let odd = i32::from(a[2 * k + 1]) * i32::from(b[2 * k + 1]);
        sums[k] += even + odd;
    }
}

#[inline(always)]
fn sum_of_products(a: &Plane, b: &Plane) -> i64 {
    let mut sums = [0i32; LANES / 2];
    for (a, b) in a.iter().zip(b) {
        add_products(a, b, &mut sums);
    }
    sums.iter().map(|&s| i64::from(s)).sum()
}

/// Takes the parts of `gradient` that are proportional to 1 and to the window itself out of it.
#[inline(always)]
fn project_out(value: &Plane, mean: i64, spread: i64, gradient: &mut Plane) {
    let mean = mean as i16;
    let (mut sum, mut products) = (0i64, 0i64);
    for (row, g) in value.iter().zip(gradient.iter()) {
        let (mut row_sum, mut row_products) = (0i32, 0i32);
        for i in 0..WINDOW {
            row_sum += i32::from(g[i]);
            row_products += i32::from(g[i]) * i32::from(row[i] - mean);
        }
        sum += i64::from(row_sum);
        products += i64::from(row_products);
    }
    // One half rounds: a remainder of the same sign in every pixel would let brightness through.
    let bias = ((sum << GAIN_BITS) / WINDOW_PIXELS) as i32 + (1 << (GAIN_BITS - 1));
    let gain = if spread > 0 { (products << GAIN_BITS) / spread } else { 0 };
    let gain = gain.clamp(-GAIN_LIMIT, GAIN_LIMIT) as i32;
    for (row, g) in value.iter().zip(gradient.iter_mut()) {
        for i in 0..WINDOW {
            let explained = (bias + gain * i32::from(row[i] - mean)) >> GAIN_BITS;
            g[i] = (i32::from(g[i]) - explained).clamp(-GRADIENT_LIMIT, GRADIENT_LIMIT) as i16;
        }
    }
}
