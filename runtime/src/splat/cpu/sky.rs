//! The directional background: looked up along every pixel's ray, shown through the last of its transmittance.

use super::adam::{BiasCorrection, adam};
use super::grid::Grid;
use super::lane::{Lane, Wide, each};
use super::simd::Dispatch;
use crate::pool::Pool;
use crate::splat::kernel_constants::{ATAN_COEFFICIENTS, MIN_DIRECTION};
use crate::splat::{
    BACKGROUND_COLUMNS, BACKGROUND_MAX_ELEVATION_RAD, BACKGROUND_MIN_ELEVATION_RAD, BACKGROUND_ROWS, BACKGROUND_TEXELS,
    View,
};
use core::f64::consts::{FRAC_PI_2, PI, TAU};
use pulp::{Simd, WithSimd};

/// One RGB table.
pub type Table = [[f32; 3]; BACKGROUND_TEXELS];

/// Bands of pixel rows whose texel gradients are summed on their own; fixed, whatever the thread count.
pub const SKY_BANDS: usize = 4;

/// Tables of all chunks with what the optimizer remembers.
pub struct Sky {
    /// Colors, [`BACKGROUND_TEXELS`] per chunk row.
    pub texels: Vec<[f32; 3]>,
    first: Vec<[f32; 3]>,
    second: Vec<[f32; 3]>,
    steps: Vec<u32>,
    band_grads: Vec<[f32; 3]>,
}

/// Bytes of one chunk row.
pub const SKY_ROW_BYTES: usize = 3 * size_of::<Table>() + size_of::<u32>();
/// Bytes of the texel gradients.
pub const SKY_GRADIENT_BYTES: usize = SKY_BANDS * size_of::<Table>();

/// A new background is this grey.
pub const INITIAL_COLOR: [f32; 3] = [0.5; 3];

impl Sky {
    /// Grey tables.
    pub fn new(chunk_rows: usize) -> Self {
        let n = chunk_rows * BACKGROUND_TEXELS;
        Self {
            texels: vec![INITIAL_COLOR; n],
            first: vec![[0.0; 3]; n],
            second: vec![[0.0; 3]; n],
            steps: vec![0; chunk_rows],
            band_grads: vec![[0.0; 3]; SKY_BANDS * BACKGROUND_TEXELS],
        }
    }

    /// Texels of a chunk row.
    pub fn row(&self, chunk_row: u16) -> Option<&[[f32; 3]]> {
        self.texels.chunks_exact(BACKGROUND_TEXELS).nth(usize::from(chunk_row))
    }

    /// Replaces a chunk row and forgets its moments; false when the row or the length is wrong, or a color is no
    /// number.
    pub fn write(&mut self, chunk_row: u16, texels: &[[f32; 3]]) -> bool {
        let row = usize::from(chunk_row);
        let fits = row < self.steps.len() && texels.len() == BACKGROUND_TEXELS;
        if !fits || !texels.as_flattened().iter().all(|v| v.is_finite()) {
            return false;
        }
        let range = row * BACKGROUND_TEXELS..(row + 1) * BACKGROUND_TEXELS;
        self.texels[range.clone()].copy_from_slice(texels);
        self.first[range.clone()].fill([0.0; 3]);
        self.second[range].fill([0.0; 3]);
        self.steps[row] = 0;
        true
    }

    /// Gradients of the texels of the view's chunk row: `transmittance * dL/drgb`, spread bilinearly; kept until
    /// the next call.
    pub fn gradients(
        &mut self,
        pool: &Pool,
        dispatch: Dispatch,
        rays: &Rays,
        grid: &Grid,
        transmittance: &[f32],
        grad_rgb: [&[f32]; 3],
    ) {
        let band_rows = grid.height.div_ceil(SKY_BANDS);
        let mut jobs = heapless::Vec::<_, SKY_BANDS>::new();
        for job in self.band_grads.chunks_exact_mut(BACKGROUND_TEXELS).enumerate() {
            if jobs.push(job).is_err() {
                unreachable!("there are SKY_BANDS tables");
            }
        }
        pool.for_each(&mut jobs, |_, (band, grads)| {
            grads.fill([0.0; 3]);
            for y in *band * band_rows..((*band + 1) * band_rows).min(grid.height) {
                let row = y * grid.width..(y + 1) * grid.width;
                let (transmittance, grad) = (&transmittance[row.clone()], grad_rgb.map(|plane| &plane[row.clone()]));
                dispatch.run(SpreadRow { rays, y, transmittance, grad, texels: grads });
            }
        });
        drop(jobs);
        let (total, parts) = self.band_grads.split_at_mut(BACKGROUND_TEXELS);
        for part in parts.chunks_exact(BACKGROUND_TEXELS) {
            for (total, part) in total.as_flattened_mut().iter_mut().zip(part.as_flattened()) {
                *total += part;
            }
        }
    }

    /// The gradients found last.
    pub fn last_gradients(&self) -> &[[f32; 3]] {
        &self.band_grads[..BACKGROUND_TEXELS]
    }

    /// One Adam step of a chunk row with the gradients found last; colors stay in [0, 1].
    pub fn step(&mut self, chunk_row: u16, rate: f32) {
        let row = usize::from(chunk_row);
        if rate <= 0.0 || row >= self.steps.len() {
            return;
        }
        self.steps[row] = self.steps[row].saturating_add(1);
        let correction = BiasCorrection::at(f64::from(self.steps[row]));
        let range = row * BACKGROUND_TEXELS..(row + 1) * BACKGROUND_TEXELS;
        let texels = self.texels[range.clone()].as_flattened_mut().iter_mut();
        let moments = self.first[range.clone()].as_flattened_mut().iter_mut();
        let moments = moments.zip(self.second[range].as_flattened_mut());
        for ((texel, (first, second)), grad) in texels.zip(moments).zip(self.band_grads.as_flattened()) {
            // A texel that no ray has met stays as it is.
            if *grad == 0.0 && *second == 0.0 {
                continue;
            }
            let [value, m, v] = adam(
                f64::from(*texel),
                f64::from(*first),
                f64::from(*second),
                f64::from(*grad),
                f64::from(rate),
                &correction,
            );
            (*texel, *first, *second) = ((value as f32).clamp(0.0, 1.0), m as f32, v as f32);
        }
    }
}

/// Directions of a view's pixels in map axes: `corner + x * right + y * down`, x and y in pixels.
#[derive(Clone, Copy, Debug)]
pub struct Rays {
    /// Ray of the corner of the picture.
    pub corner: [f64; 3],
    /// Change per px to the right.
    pub right: [f64; 3],
    /// Change per px down.
    pub down: [f64; 3],
}

impl Rays {
    /// Rays of a view.
    pub fn of(view: &View) -> Self {
        let map_from_camera = view.camera_from_map.rotation.inverse().to_rotation_matrix();
        let camera = &view.camera;
        let axis = |x: f64, y: f64, z: f64| (map_from_camera * nalgebra::Vector3::new(x, y, z)).into();
        Self {
            corner: axis(-camera.cx / camera.fx, -camera.cy / camera.fy, 1.0),
            right: axis(1.0 / camera.fx, 0.0, 0.0),
            down: axis(0.0, 1.0 / camera.fy, 0.0),
        }
    }

    /// Ray of the middle of a pixel, not normalised.
    #[inline(always)]
    pub fn direction(&self, x: usize, y: usize) -> [f64; 3] {
        let (x_px, y_px) = (x as f64 + 0.5, y as f64 + 0.5);
        each!(i in 3 => self.corner[i] + x_px * self.right[i] + y_px * self.down[i])
    }

    /// Table coordinates of the pixel (x, y): column in 0..=[`BACKGROUND_COLUMNS`] and row, both of texel centres.
    #[inline(always)]
    pub fn texel<L: Lane>(&self, x_px: L, y_px: L) -> [L; 2] {
        let direction = each!(i in 3 => {
            let from_corner = x_px.mul_add(x_px.constant(self.right[i]), x_px.constant(self.corner[i]));
            y_px.mul_add(y_px.constant(self.down[i]), from_corner)
        });
        let [x, y, z] = direction;
        let azimuth_rad = atan2(x, z);
        let elevation_rad = atan2(-y, (x * x + z * z).sqrt());
        let turn = azimuth_rad.replace(azimuth_rad.lt(azimuth_rad.zero()), azimuth_rad + azimuth_rad.constant(TAU));
        let (low, high) = (f64::from(BACKGROUND_MIN_ELEVATION_RAD), f64::from(BACKGROUND_MAX_ELEVATION_RAD));
        let row = (elevation_rad - x.constant(low)) * x.constant(BACKGROUND_ROWS as f64 / (high - low));
        let half = x.constant(0.5);
        let last_row = x.constant(BACKGROUND_ROWS as f64 - 1.0);
        [turn * x.constant(BACKGROUND_COLUMNS as f64 / TAU) + half, (row - half).clamp(x.zero(), last_row)]
    }
}

/// Angle of (x, y) from the x axis, rad in -pi..=pi; absolute error below 1e-6 in f32.
///
/// # Source
/// Odd polynomial on [0, 1] with the usual reflections; own fit (iteratively reweighted least squares).
#[inline(always)]
fn atan2<L: Lane>(y: L, x: L) -> L {
    let (ax, ay) = (x.abs(), y.abs());
    let (small, large) = (ax.min(ay), ax.max(ay));
    let ratio = small / large.max(large.constant(MIN_DIRECTION));
    let square = ratio * ratio;
    let mut sum = ratio.constant(ATAN_COEFFICIENTS[0]);
    for &coefficient in &ATAN_COEFFICIENTS[1..] {
        sum = sum.mul_add(square, ratio.constant(coefficient));
    }
    let angle = sum * ratio;
    let angle = angle.replace(ax.lt(ay), angle.constant(FRAC_PI_2) - angle);
    let angle = angle.replace(x.lt(x.zero()), angle.constant(PI) - angle);
    angle.replace(y.lt(y.zero()), -angle)
}

/// Where a pixel falls between four texels.
pub struct Corners {
    /// The texels: left and right of the upper row, then of the lower one.
    pub at: [usize; 4],
    weight: [f32; 4],
    /// Place between left and right, and between up and down, 0 to 1.
    pub between: [f32; 2],
}

impl Corners {
    /// `column` is shifted by one so that it is never negative.
    #[inline(always)]
    pub fn new(column: f32, row: f32) -> Self {
        let (left, top) = (column as usize, row as usize);
        let (fx, fy) = (column - left as f32, row - top as f32);
        let columns = [(left + BACKGROUND_COLUMNS - 1) % BACKGROUND_COLUMNS, left % BACKGROUND_COLUMNS];
        let rows = [top.min(BACKGROUND_ROWS - 1), (top + 1).min(BACKGROUND_ROWS - 1)];
        Self {
            at: each!(i in 4 => rows[i / 2] * BACKGROUND_COLUMNS + columns[i % 2]),
            weight: [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy],
            between: [fx, fy],
        }
    }
}

/// Pixels of a row that are looked up together.
pub const LOOKUP: usize = 16;

/// Columns and rows of pixels from (x, y) to the right.
#[inline(always)]
pub fn lookup_columns<S: Simd>(simd: S, rays: &Rays, x: usize, y: usize) -> [[f32; LOOKUP]; 2] {
    let mut out = [[0.0; LOOKUP]; 2];
    for lane in (0..LOOKUP).step_by(S::F32_LANES) {
        let x_px = Wide::load(simd, &STEPS[lane..]) + Wide::splat(simd, x as f32 + 0.5);
        let [column, row] = rays.texel(x_px, Wide::splat(simd, y as f32 + 0.5));
        column.store(&mut out[0][lane..]);
        row.store(&mut out[1][lane..]);
    }
    out
}

const STEPS: [f32; LOOKUP] = [0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11., 12., 13., 14., 15.];

/// Adds the background to one row of pixels.
pub struct ComposeRow<'a> {
    /// Rays of the view.
    pub rays: &'a Rays,
    /// The row.
    pub y: usize,
    /// The chunk's table.
    pub texels: &'a [[f32; 3]],
    /// Final transmittance of the row.
    pub transmittance: &'a [f32],
    /// Red, green and blue of the row.
    pub rgb: [&'a mut [f32]; 3],
}

impl WithSimd for ComposeRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let [red, green, blue] = self.rgb;
        for (i, transmittance) in self.transmittance.chunks(LOOKUP).enumerate() {
            let [columns, rows] = lookup_columns(simd, self.rays, i * LOOKUP, self.y);
            for (lane, &transmittance) in transmittance.iter().enumerate() {
                let corners = Corners::new(columns[lane], rows[lane]);
                let x = i * LOOKUP + lane;
                for (&at, weight) in corners.at.iter().zip(corners.weight) {
                    let [r, g, b] = self.texels[at];
                    let weight = weight * transmittance;
                    red[x] += weight * r;
                    green[x] += weight * g;
                    blue[x] += weight * b;
                }
            }
        }
    }
}

/// Spreads one row's gradients over the texels.
struct SpreadRow<'a> {
    rays: &'a Rays,
    y: usize,
    transmittance: &'a [f32],
    grad: [&'a [f32]; 3],
    texels: &'a mut [[f32; 3]],
}

impl WithSimd for SpreadRow<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for (i, transmittance) in self.transmittance.chunks(LOOKUP).enumerate() {
            let [columns, rows] = lookup_columns(simd, self.rays, i * LOOKUP, self.y);
            for (lane, &transmittance) in transmittance.iter().enumerate() {
                let corners = Corners::new(columns[lane], rows[lane]);
                let x = i * LOOKUP + lane;
                let grad = self.grad.map(|plane| plane[x] * transmittance);
                for (&at, weight) in corners.at.iter().zip(corners.weight) {
                    for (texel, grad) in self.texels[at].iter_mut().zip(grad) {
                        *texel += weight * grad;
                    }
                }
            }
        }
    }
}
