//! Where a keyframe's window is now, and how it has been stretched.
//!
//! On a moving vehicle a window of the road grows by a third per frame: a window that can only be shifted then
//! settles beside the point. Here it may also be deformed linearly.

use super::lanes::{Kernel, KernelTask, SimdLevel};
use super::resample::sample;
use crate::frame::Pyramid;
use crate::frame::pyramid::PaddedImage;
use nalgebra::{Matrix2, Matrix6, Vector2, Vector6};

/// Constants of the refinement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AffineSettings {
    /// Gauss-Newton steps at most. Range 0..=50, 0 leaves the refinement out; ours.
    pub max_steps: u32,
    /// A step that moves the centre by less ends the refinement, px. Range (0, 0.5]; as in OpenCV's LK.
    pub converged_px: f32,
    /// Correlation with the keyframe's window below which they do not show the same. Range [-1, 1]; ours.
    pub min_correlation: f32,
    /// How far the refinement may move a point, px: beyond, chain and keyframe disagree. Range (0, 10]; ours.
    pub max_moved_px: f32,
    /// Largest stretch of an axis, and the inverse of the smallest. Range (1, 10]; ours.
    pub max_stretch: f32,
    /// Standard deviation of grey values that the two windows may differ by, grey values. Range (0, 50]; ours.
    pub noise: f32,
    /// Standard deviation of the change of shape in one step, against which the noise is weighed. Range (0, 1]; ours.
    pub shape_sigma: f32,
}

impl AffineSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        max_steps: 10,
        converged_px: 0.01,
        min_correlation: 0.8,
        max_moved_px: 2.0,
        max_stretch: 3.0,
        noise: 3.0,
        shape_sigma: 0.1,
    };
}

/// Where a window is, and its shape: a pixel `w` from the keyframe's centre is at `center + shape * w`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Placement {
    /// Pixel of the centre, px.
    pub center_px: [f32; 2],
    /// Linear map of offsets, rows of the matrix.
    pub shape: [[f32; 2]; 2],
}

impl Placement {
    /// An undeformed window.
    pub const fn at(center_px: [f32; 2]) -> Self {
        Self { center_px, shape: [[1.0, 0.0], [0.0, 1.0]] }
    }
}

/// What became of one window.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum AffineVerdict {
    /// Not refined yet.
    Pending,
    /// Placed.
    Placed {
        /// Correlation of the two windows, in [-1, 1].
        correlation: f32,
    },
    /// The window is not in the image with its margin; also where a coordinate is no number.
    LeftImage,
    /// The windows do not look the same.
    Different {
        /// Correlation of the two windows.
        correlation: f32,
    },
    /// The refinement led too far away.
    Inconsistent {
        /// Distance from the start, px.
        moved_px: f32,
    },
    /// The window has been deformed beyond the limit, or its texture does not hold six parameters.
    Collapsed,
}

/// One window to be refined.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AffineFlow {
    /// Centre of the window in the keyframe, px.
    pub keyframe_px: [f32; 2],
    /// In: where it is expected. Out: where it is, when it was placed.
    pub placement: Placement,
    /// What became of it.
    pub verdict: AffineVerdict,
}

/// Refines every pending window of `flows` on the full images.
///
/// Minimises  Σ_w (J(c + A w) - g I(p + w) - b)²  over centre c, shape A, contrast g and brightness b by the inverse
/// compositional method: gradients and their 6 x 6 matrix are the keyframe's and computed once.
///
/// # Output
/// `placement` and `verdict` of every flow that was pending.
///
/// # Cost
/// O(n * steps), about 1 µs per step; 9 KiB of stack; no allocation. Same bits on every SIMD level.
///
/// # Source
/// Baker & Matthews 2004, fig. 4; contrast and brightness by linear regression in every step (own addition).
pub fn refine(
    simd: SimdLevel,
    keyframe: &Pyramid<'_>,
    current: &Pyramid<'_>,
    settings: &AffineSettings,
    flows: &mut [AffineFlow],
) {
    let (Some(from), Some(to)) = (keyframe.level(0), current.level(0)) else { return };
    simd.run(Refine { from, to, settings, flows });
}

struct Refine<'a> {
    from: PaddedImage<'a>,
    to: PaddedImage<'a>,
    settings: &'a AffineSettings,
    flows: &'a mut [AffineFlow],
}

impl KernelTask for Refine<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        for flow in self.flows.iter_mut() {
            if flow.verdict != AffineVerdict::Pending {
                continue;
            }
            flow.verdict = match Window::of_keyframe(&self.from, flow.keyframe_px) {
                Some(window) => place(kernel, &window, &self.to, self.settings, &mut flow.placement),
                None => AffineVerdict::LeftImage,
            };
        }
    }
}

/// Side of the window, px; the same as that of the translational search.
const WINDOW: usize = super::window::WINDOW;
const HALF: f32 = (WINDOW / 2) as f32;
const WINDOW_PIXELS: f32 = (WINDOW * WINDOW) as f32;

/// Columns rounded up to whole registers; those beyond the window are zero.
const LANES: usize = 24;
type Plane = [[f32; LANES]; WINDOW];
type Lane = [f32; LANES];

/// Offsets of the columns from the centre.
const OFFSETS: Lane = {
    let mut offsets = [0.0; LANES];
    let mut i = 0;
    while i < WINDOW {
        offsets[i] = i as f32 - HALF;
        i += 1;
    }
    offsets
};

/// The keyframe's window: values without their mean, gradients, and the matrix of the steepest descent.
struct Window {
    value: Plane,
    gradient_x: Plane,
    gradient_y: Plane,
    spread: f32,
    matrix: Matrix6<f32>,
}

impl Window {
    #[inline(always)]
    fn of_keyframe(level: &PaddedImage<'_>, center_px: [f32; 2]) -> Option<Self> {
        let mut grown = [[0.0f32; LANES + 2]; WINDOW + 2];
        sample(level, &Placement::at(center_px), &mut grown)?;
        let mut window = Self {
            value: [[0.0; LANES]; WINDOW],
            gradient_x: [[0.0; LANES]; WINDOW],
            gradient_y: [[0.0; LANES]; WINDOW],
            spread: 0.0,
            matrix: Matrix6::zeros(),
        };
        for r in 0..WINDOW {
            for i in 0..WINDOW {
                window.value[r][i] = grown[r + 1][i + 1];
                window.gradient_x[r][i] = 0.5 * (grown[r + 1][i + 2] - grown[r + 1][i]);
                window.gradient_y[r][i] = 0.5 * (grown[r + 2][i + 1] - grown[r][i + 1]);
            }
        }
        window.spread = center_values(&mut window.value);
        window.matrix = window.steepest_descent_matrix();
        Some(window)
    }

    /// `Σ s sᵀ` of the steepest descent `s = [gx, gy, gx x, gx y, gy x, gy y]`.
    #[inline(always)]
    fn steepest_descent_matrix(&self) -> Matrix6<f32> {
        // Per product of gradients (xx, xy, yy): moments of order 0, 1 and 2 in y, per column.
        let mut columns = [[[0.0f32; LANES]; 3]; 3];
        for r in 0..WINDOW {
            let y = r as f32 - HALF;
            for i in 0..LANES {
                let (gx, gy) = (self.gradient_x[r][i], self.gradient_y[r][i]);
                for (moments, product) in columns.iter_mut().zip([gx * gx, gx * gy, gy * gy]) {
                    moments[0][i] += product;
                    moments[1][i] += product * y;
                    moments[2][i] += product * y * y;
                }
            }
        }
        let (xx, xy, yy) = (moments(&columns[0]), moments(&columns[1]), moments(&columns[2]));
        let block = |m: [f32; 6]| {
            let [one, x, y, x2, xy, y2] = m;
            [[one, x, y], [x, x2, xy], [y, xy, y2]]
        };
        let (xx, xy, yy) = (block(xx), block(xy), block(yy));
        // Parameter k is gradient component `component[k]` times basis function `basis[k]` of (1, x, y).
        let component = [0, 1, 0, 0, 1, 1];
        let basis = [0, 0, 1, 2, 1, 2];
        Matrix6::from_fn(|row, column| {
            let products = match component[row] + component[column] {
                0 => &xx,
                1 => &xy,
                _ => &yy,
            };
            products[basis[row]][basis[column]]
        })
    }
}

/// Moments 1, x, y, xx, xy, yy of a product from its moments of order 0, 1 and 2 in y per column.
#[inline(always)]
fn moments([one, y, y2]: &[Lane; 3]) -> [f32; 6] {
    let [mut x, mut x2, mut xy] = [[0.0f32; LANES]; 3];
    for i in 0..LANES {
        x[i] = one[i] * OFFSETS[i];
        x2[i] = x[i] * OFFSETS[i];
        xy[i] = y[i] * OFFSETS[i];
    }
    [total(one), total(&x), total(y), total(&x2), total(&xy), total(y2)]
}

/// Gauss-Newton steps for one window.
#[inline(always)]
fn place<K: Kernel>(
    kernel: K,
    window: &Window,
    level: &PaddedImage<'_>,
    settings: &AffineSettings,
    placement: &mut Placement,
) -> AffineVerdict {
    let start_px = placement.center_px;
    let Some(inverse) = damped_inverse(&window.matrix, settings) else { return AffineVerdict::Collapsed };
    let mut found = *placement;
    let mut correlation = 0.0;
    let mut values = [[0.0f32; LANES]; WINDOW];
    for _ in 0..settings.max_steps {
        if sample(level, &found, &mut values).is_none() {
            return AffineVerdict::LeftImage;
        }
        let spread = center_values(&mut values);
        let together = sum_of_products(&values, &window.value);
        let norm = kernel.sqrt((spread * window.spread).into()) as f32;
        correlation = if norm > 0.0 { together / norm } else { 0.0 };
        if correlation <= 0.0 {
            return AffineVerdict::Different { correlation };
        }
        let contrast = together / window.spread;
        let step = inverse * descent(window, &values, contrast);
        let Some(moved) = compose(&found, &step) else { return AffineVerdict::Collapsed };
        let [dx, dy] = [0, 1].map(|k: usize| moved.center_px[k] - found.center_px[k]);
        found = moved;
        if !is_plausible(&found, settings.max_stretch) {
            return AffineVerdict::Collapsed;
        }
        if dx * dx + dy * dy < settings.converged_px * settings.converged_px {
            break;
        }
    }
    let [dx, dy] = [0, 1].map(|k: usize| found.center_px[k] - start_px[k]);
    let moved_px = kernel.sqrt((dx * dx + dy * dy).into()) as f32;
    if correlation < settings.min_correlation {
        return AffineVerdict::Different { correlation };
    }
    if moved_px > settings.max_moved_px || moved_px.is_nan() {
        return AffineVerdict::Inconsistent { moved_px };
    }
    *placement = found;
    AffineVerdict::Placed { correlation }
}

/// `Σ s (J / contrast - I)` over the window.
#[inline(always)]
fn descent(window: &Window, values: &Plane, contrast: f32) -> Vector6<f32> {
    let mut sums = [[0.0f32; LANES]; 4];
    let scale = 1.0 / contrast;
    for (r, row) in values.iter().enumerate() {
        let y = r as f32 - HALF;
        for i in 0..LANES {
            let difference = row[i] * scale - window.value[r][i];
            let (ex, ey) = (window.gradient_x[r][i] * difference, window.gradient_y[r][i] * difference);
            sums[0][i] += ex;
            sums[1][i] += ey;
            sums[2][i] += ex * y;
            sums[3][i] += ey * y;
        }
    }
    let [mut ex_x, mut ey_x] = [[0.0f32; LANES]; 2];
    for i in 0..LANES {
        ex_x[i] = sums[0][i] * OFFSETS[i];
        ey_x[i] = sums[1][i] * OFFSETS[i];
    }
    let [ex, ey, ex_y, ey_y] = &sums;
    Vector6::new(total(ex), total(ey), total(&ex_x), total(ex_y), total(&ey_x), total(ey_y))
}

/// Inverse of the matrix with a prior on the change of shape. Not inlined into SIMD code: its roots would stall it.
#[inline(never)]
fn damped_inverse(matrix: &Matrix6<f32>, settings: &AffineSettings) -> Option<Matrix6<f32>> {
    let prior = settings.noise * settings.noise / (settings.shape_sigma * settings.shape_sigma);
    let mut damped = *matrix;
    for k in 2..6 {
        damped[(k, k)] += prior;
    }
    Some(damped.cholesky()?.inverse())
}

/// `placement` after the inverse of `step`; `None` when the step cannot be inverted.
#[inline(always)]
fn compose(placement: &Placement, step: &Vector6<f32>) -> Option<Placement> {
    let [[a, b], [c, d]] = placement.shape;
    let change = Matrix2::new(1.0 + step[2], step[3], step[4], 1.0 + step[5]);
    let determinant = change.determinant();
    if determinant.abs() < 1e-3 || determinant.is_nan() {
        return None;
    }
    let inverse = Matrix2::new(change.m22, -change.m12, -change.m21, change.m11) / determinant;
    let shape = Matrix2::new(a, b, c, d) * inverse;
    let shift = shape * Vector2::new(step[0], step[1]);
    let [x, y] = placement.center_px;
    Some(Placement { center_px: [x - shift.x, y - shift.y], shape: [[shape.m11, shape.m12], [shape.m21, shape.m22]] })
}

/// Whether no axis is stretched or shrunk beyond the limit, nor the window turned over.
#[inline(always)]
fn is_plausible(placement: &Placement, max_stretch: f32) -> bool {
    let [[a, b], [c, d]] = placement.shape;
    let determinant = a * d - b * c;
    // The squared stretches add up to the squared norm and multiply to the squared determinant.
    let norm2 = a * a + b * b + c * c + d * d;
    let largest2 = max_stretch * max_stretch;
    determinant > 0.0 && norm2 <= largest2 + 1.0 && determinant * determinant * largest2 >= 1.0 / largest2
}

/// Subtracts the mean from the lanes of the window; returns the sum of squares that is left.
#[inline(always)]
fn center_values(values: &mut Plane) -> f32 {
    let mut sums = [0.0f32; LANES];
    for row in values.iter() {
        for i in 0..LANES {
            sums[i] += row[i];
        }
    }
    let mean = total(&sums) / WINDOW_PIXELS;
    for row in values.iter_mut() {
        for value in row.iter_mut().take(WINDOW) {
            *value -= mean;
        }
    }
    sum_of_products(values, values)
}

#[inline(always)]
fn sum_of_products(a: &Plane, b: &Plane) -> f32 {
    let mut sums = [0.0f32; LANES];
    for (a, b) in a.iter().zip(b) {
        for i in 0..LANES {
            sums[i] += a[i] * b[i];
        }
    }
    total(&sums)
}

/// Sum of the lanes, in a fixed order.
#[inline(always)]
fn total(lanes: &Lane) -> f32 {
    let mut eight = [0.0f32; 8];
    for i in 0..8 {
        eight[i] = lanes[i] + lanes[i + 8] + lanes[i + 16];
    }
    let [a, b, c, d, e, f, g, h] = eight;
    ((a + e) + (c + g)) + ((b + f) + (d + h))
}

#[cfg(test)]
mod tests;
