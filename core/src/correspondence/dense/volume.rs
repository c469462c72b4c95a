//! How well every displacement of every node fits, as bytes: 0 is nothing, 255 the same picture.

use super::storage::{Grid, STRIDE};
use crate::correspondence::ImagePair;
use crate::features::SimdLevel;
use crate::features::lanes::{Kernel, KernelTask};
use crate::frame::pyramid::PaddedImage;

/// Displacements per axis, from `-REACH` on: 32 lanes.
pub(super) const SIDE: usize = 32;
/// Farthest displacement, level px.
pub(super) const REACH: usize = SIDE / 2;
/// Displacements of one node, row by row.
pub(super) const BYTES_PER_NODE: usize = SIDE * SIDE;
/// Numbers per pixel: the grey value and the inverse norm of the window around it.
pub(super) const PLANES: usize = 2;

/// Side of the compared windows, level px: at an eighth, 56 px of the image.
const PATCH: usize = 7;
const HALF: usize = PATCH / 2;
const PATCH_PIXELS: f32 = (PATCH * PATCH) as f32;
/// Columns and rows around the level that displaced windows may touch.
const PAD: usize = REACH + HALF + 1;

type Displacements = [[u8; SIDE]; SIDE];

/// Numbers of one padded plane.
pub(super) fn plane_len(grid: &Grid) -> usize {
    (grid.width + 2 * PAD) * (grid.height + 2 * PAD)
}

/// Fills `volume` with the squared correlations of the 7 x 7 px windows; negative ones, flat windows and what lies
/// outside the image count as nothing.
pub(super) fn correlate(
    simd: SimdLevel,
    pair: &ImagePair<'_>,
    grid: &Grid,
    noise: f32,
    planes: &mut [f32],
    volume: &mut [u8],
) {
    let (Some(keyframe), Some(current)) = (pair.keyframe.level(grid.level), pair.current.level(grid.level)) else {
        return;
    };
    let (gray, rest) = planes.split_at_mut(plane_len(grid));
    let inverse_norms = &mut rest[..plane_len(grid)];
    pad(grid, &current, gray);
    measure(grid, noise, gray, inverse_norms);
    simd.run(Correlate { keyframe, grid, noise, gray, inverse_norms, volume });
}

/// Copies the level, repeating its border.
fn pad(grid: &Grid, level: &PaddedImage<'_>, gray: &mut [f32]) {
    let image = level.image();
    for (y, row) in gray.chunks_exact_mut(grid.width + 2 * PAD).enumerate() {
        let pixels = image.row(y.saturating_sub(PAD).min(grid.height - 1));
        for (x, value) in row.iter_mut().enumerate() {
            *value = f32::from(pixels[x.saturating_sub(PAD).min(grid.width - 1)]);
        }
    }
}

/// Inverse norm of the window around every pixel of the image, without its mean; 0 outside.
fn measure(grid: &Grid, noise: f32, gray: &[f32], inverse_norms: &mut [f32]) {
    let stride = grid.width + 2 * PAD;
    inverse_norms.fill(0.0);
    for y in PAD..PAD + grid.height {
        for x in PAD..PAD + grid.width {
            let (mut sum, mut squares) = (0.0f32, 0.0f32);
            for row in gray.chunks_exact(stride).skip(y - HALF).take(PATCH) {
                for value in &row[x - HALF..x - HALF + PATCH] {
                    sum += value;
                    squares += value * value;
                }
            }
            inverse_norms[y * stride + x] = inverse_norm(squares - sum * sum / PATCH_PIXELS, noise);
        }
    }
}

fn inverse_norm(spread: f32, noise: f32) -> f32 {
    1.0 / libm::sqrtf(spread.max(0.0) + PATCH_PIXELS * noise * noise)
}

struct Correlate<'a> {
    keyframe: PaddedImage<'a>,
    grid: &'a Grid,
    noise: f32,
    gray: &'a [f32],
    inverse_norms: &'a [f32],
    volume: &'a mut [u8],
}

impl KernelTask for Correlate<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let grid = self.grid;
        let stride = grid.width + 2 * PAD;
        let (blocks, _) = self.volume.as_chunks_mut::<SIDE>();
        let (blocks, _) = blocks.as_chunks_mut::<SIDE>();
        for (i, block) in blocks.iter_mut().take(grid.n_nodes()).enumerate() {
            let (x, y) = node_pixel(grid, i);
            *block = [[0; SIDE]; SIDE];
            let Some((patch, scale)) = patch_of(kernel, &self.keyframe, x, y, self.noise) else { continue };
            for (dy, scores) in block.iter_mut().enumerate() {
                // Left end of the displaced windows in the padded plane, and their centres.
                let first = (y + PAD + dy - REACH) * stride + x + PAD - REACH;
                let mut sums = [0.0f32; SIDE];
                for (r, taps) in patch.iter().enumerate() {
                    let start = first + r * stride - HALF * stride - HALF;
                    let Some(row) = self.gray.get(start..start + SIDE + PATCH) else { continue };
                    for (c, tap) in taps.iter().enumerate() {
                        let Some(values) = row[c..].first_chunk::<SIDE>() else { continue };
                        for k in 0..SIDE {
                            sums[k] += tap * values[k];
                        }
                    }
                }
                let norms = self.inverse_norms.get(first..).and_then(|row| row.first_chunk::<SIDE>());
                let Some(norms) = norms else { continue };
                for k in 0..SIDE {
                    let correlation = (sums[k] * norms[k] * scale).max(0.0);
                    scores[k] = (255.0 * correlation * correlation) as u8;
                }
            }
        }
    }
}

/// Pixel of a node on its level.
pub(super) fn node_pixel(grid: &Grid, i: usize) -> (usize, usize) {
    (STRIDE * (i % grid.columns) + STRIDE / 2, STRIDE * (i / grid.columns) + STRIDE / 2)
}

/// The keyframe's window without its mean, and its inverse norm.
#[inline(always)]
fn patch_of<K: Kernel>(
    kernel: K,
    level: &PaddedImage<'_>,
    x: usize,
    y: usize,
    noise: f32,
) -> Option<([[f32; PATCH]; PATCH], f32)> {
    let bytes = level.from_pixel(x as i32 - HALF as i32, y as i32 - HALF as i32)?;
    let mut patch = [[0.0f32; PATCH]; PATCH];
    let mut sum = 0.0;
    for (r, row) in patch.iter_mut().enumerate() {
        let pixels: &[u8; PATCH] = bytes.get(r * level.stride()..)?.first_chunk()?;
        for (value, &pixel) in row.iter_mut().zip(pixels) {
            *value = f32::from(pixel);
            sum += *value;
        }
    }
    let mean = sum / PATCH_PIXELS;
    let mut spread = 0.0;
    for value in patch.as_flattened_mut() {
        *value -= mean;
        spread += *value * *value;
    }
    let norm = kernel.sqrt((spread + PATCH_PIXELS * noise * noise).into()) as f32;
    Some((patch, 1.0 / norm))
}

/// Lets every node add what its neighbours, `2^round` nodes away, found for displacements up to `2^round` px away.
///
/// A node `n` px away moves by `n / 2` px more or less when the image is zoomed by a factor of 1.5 or 0.5.
pub(super) fn share(simd: SimdLevel, grid: &Grid, round: u32, pooled: &mut [u8], volume: &mut [u8]) {
    simd.run(Share { grid, round, pooled, volume });
}

struct Share<'a> {
    grid: &'a Grid,
    round: u32,
    pooled: &'a mut [u8],
    volume: &'a mut [u8],
}

impl KernelTask for Share<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, _kernel: K) {
        let Self { grid, round, pooled, volume } = self;
        let distance = 1 << round;
        let blocks = |bytes: &'_ mut [u8]| -> usize { bytes.len() / BYTES_PER_NODE };
        let n = grid.n_nodes().min(blocks(volume)).min(blocks(pooled));
        let (volume, _) = volume.as_chunks_mut::<SIDE>();
        let (volume, _) = volume.as_chunks_mut::<SIDE>();
        let (pooled, _) = pooled.as_chunks_mut::<SIDE>();
        let (pooled, _) = pooled.as_chunks_mut::<SIDE>();
        for (own, pooled) in volume.iter().zip(pooled.iter_mut()).take(n) {
            *pooled = *own;
            for _ in 0..distance {
                pool(pooled);
            }
        }
        for (i, own) in volume.iter_mut().enumerate().take(n) {
            let (column, row) = ((i % grid.columns) as i32, (i / grid.columns) as i32);
            let mut sums = [[0u16; SIDE]; SIDE];
            let mut weight = OWN_WEIGHT;
            for (sums, own) in sums.iter_mut().zip(own.iter()) {
                for k in 0..SIDE {
                    sums[k] = OWN_WEIGHT * u16::from(own[k]);
                }
            }
            for (dx, dy) in NEIGHBOURS {
                let (x, y) = (column + dx * distance, row + dy * distance);
                let is_inside = (0..grid.columns as i32).contains(&x) && (0..grid.rows as i32).contains(&y);
                if is_inside {
                    add(&mut sums, &pooled[y as usize * grid.columns + x as usize]);
                    weight += 1;
                }
            }
            let factor = 65536 / u32::from(weight);
            for (own, sums) in own.iter_mut().zip(&sums) {
                for k in 0..SIDE {
                    own[k] = ((u32::from(sums[k]) * factor) >> 16) as u8;
                }
            }
        }
    }
}

/// What a node's own finding weighs against one neighbour's. Ours.
const OWN_WEIGHT: u16 = 4;

const NEIGHBOURS: [(i32, i32); 8] = [(-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)];

#[inline(always)]
fn add(sums: &mut [[u16; SIDE]; SIDE], other: &Displacements) {
    for (sums, other) in sums.iter_mut().zip(other) {
        for k in 0..SIDE {
            sums[k] += u16::from(other[k]);
        }
    }
}

/// The greatest of 3 x 3 displacements.
#[inline(always)]
fn pool(block: &mut Displacements) {
    let mut rows = [[0u8; SIDE]; SIDE + 2];
    for (out, row) in rows.iter_mut().skip(1).zip(block.iter()) {
        let mut grown = [0u8; SIDE + 2];
        grown[1..=SIDE].copy_from_slice(row);
        for k in 0..SIDE {
            out[k] = grown[k].max(grown[k + 1]).max(grown[k + 2]);
        }
    }
    for (r, out) in block.iter_mut().enumerate() {
        for k in 0..SIDE {
            out[k] = rows[r][k].max(rows[r + 1][k]).max(rows[r + 2][k]);
        }
    }
}
