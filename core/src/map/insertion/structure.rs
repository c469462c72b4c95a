//! What counts as structure of a picture: the paper's difference of Gaussians, and what it is compared with.

use super::MapImageSize;

/// Operator that finds structure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StructureOperator {
    /// `|(G_s1 - G_s2) * luma|`. The paper, section 3.3.1.
    DifferenceOfGaussians,
    /// `|laplacian(G_s1 * luma)|`. Marr & Hildreth 1980.
    LaplacianOfGaussian,
    /// 1 on edges of `G_s1 * luma`, 0 elsewhere. Canny 1986.
    Canny,
    /// None: places are drawn.
    Random,
}

/// Radius beyond which a Gaussian's weight is below a thousandth.
const KERNEL_RADIUS_SIGMAS: f32 = 3.0;
/// Taps on one side of the widest allowed kernel.
const MAX_KERNEL_RADIUS: usize = 12;

/// Gradient of an edge that is one by itself, and of one that continues such an edge, 1/px. About OpenCV's usual 200 and
/// 100 of an 8-bit Sobel operator.
const CANNY_GRADIENTS: [f32; 2] = [0.1, 0.05];
/// Passes over the image in which edges are continued at most.
const MAX_EDGE_PASSES: usize = 8;
/// An edge that may turn out to continue another.
const MAYBE: f32 = 0.5;

/// Writes what `operator` finds to `structure`; borders repeat the outermost pixel.
///
/// All slices hold one value per pixel; luma is in [0, 1].
///
/// # Source
/// See [`StructureOperator`]; separable Gaussians.
pub fn find_structure(
    operator: StructureOperator,
    (luma, size): (&[f32], MapImageSize),
    sigmas_px: [f32; 2],
    scratch: &mut [f32],
    structure: &mut [f32],
) {
    if operator == StructureOperator::Random {
        structure.fill(0.0);
        return;
    }
    blur(luma, size, sigmas_px[0], scratch, structure, |_, blurred| blurred);
    match operator {
        StructureOperator::LaplacianOfGaussian => {
            for_each_neighbourhood(structure, size, scratch, |middle, [left, right, above, below]| {
                (left + right + above + below - 4.0 * middle).abs()
            });
            structure.copy_from_slice(scratch);
        }
        StructureOperator::Canny => canny(size, scratch, structure),
        _ => blur(luma, size, sigmas_px[1], scratch, structure, |fine, coarse| (fine - coarse).abs()),
    }
}

/// Writes what `of` says about each pixel and its neighbours left, right, above and below.
fn for_each_neighbourhood(image: &[f32], size: MapImageSize, out: &mut [f32], of: impl Fn(f32, [f32; 4]) -> f32) {
    let MapImageSize { width, height } = size;
    let at = |x: usize, y: usize| image.get(y * width + x).copied().unwrap_or(0.0);
    for (y, row) in out.chunks_exact_mut(width).enumerate().take(height) {
        for (x, value) in row.iter_mut().enumerate() {
            let (right, below) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
            *value = of(at(x, y), [at(x.saturating_sub(1), y), at(right, y), at(x, y.saturating_sub(1)), at(x, below)]);
        }
    }
}

/// Turns a blurred image into its edges: gradients, the crests among them, hysteresis.
fn canny(size: MapImageSize, gradient: &mut [f32], image: &mut [f32]) {
    let MapImageSize { width, height } = size;
    for_each_neighbourhood(image, size, gradient, |_, [left, right, above, below]| {
        0.5 * libm::sqrtf((right - left) * (right - left) + (below - above) * (below - above))
    });
    for y in 0..height {
        for x in 0..width {
            let at = |x: usize, y: usize| image.get(y * width + x).copied().unwrap_or(0.0);
            let gx = at((x + 1).min(width - 1), y) - at(x.saturating_sub(1), y);
            let gy = at(x, (y + 1).min(height - 1)) - at(x, y.saturating_sub(1));
            let (dx, dy) = direction(gx, gy);
            // Pixels that are no crest are marked by their sign, so that their neighbours still see how steep they are.
            let steepness = |sign: isize| {
                let (u, v) = (x.checked_add_signed(sign * dx), y.checked_add_signed(sign * dy));
                let index = u.zip(v).filter(|(u, v)| *u < width && *v < height).map(|(u, v)| v * width + u);
                index.and_then(|index| gradient.get(index)).map_or(0.0, |value| value.abs())
            };
            let middle = steepness(0);
            let is_crest = middle >= steepness(-1) && middle > steepness(1);
            if let Some(value) = gradient.get_mut(y * width + x).filter(|_| !is_crest) {
                *value = -middle;
            }
        }
    }
    for (edge, &steepness) in image.iter_mut().zip(&*gradient) {
        let [sure, maybe] = CANNY_GRADIENTS;
        *edge = f32::from(steepness >= sure).max(if steepness >= maybe { MAYBE } else { 0.0 });
    }
    continue_edges(size, image);
}

/// The neighbour that a gradient points to, in steps of 45 degrees.
fn direction(gx: f32, gy: f32) -> (isize, isize) {
    // tan(22.5 degrees)
    const FLAT: f32 = 0.414_213_57;
    let (ax, ay) = (gx.abs(), gy.abs());
    let sign = |g: f32| if g < 0.0 { -1 } else { 1 };
    (if ax > FLAT * ay { sign(gx) } else { 0 }, if ay > FLAT * ax { sign(gy) } else { 0 })
}

/// Whatever may be an edge is one when it touches one, and none else.
fn continue_edges(size: MapImageSize, edges: &mut [f32]) {
    let MapImageSize { width, height } = size;
    for _ in 0..MAX_EDGE_PASSES {
        let mut any = false;
        for index in 0..size.n_pixels() {
            let (x, y) = (index % width, index / width);
            let is_edge = |edges: &[f32], u: usize, v: usize| edges.get(v * width + u).is_some_and(|edge| *edge == 1.0);
            let touches = (y.saturating_sub(1)..(y + 2).min(height))
                .any(|v| (x.saturating_sub(1)..(x + 2).min(width)).any(|u| is_edge(edges, u, v)));
            if let Some(edge) = edges.get_mut(index).filter(|edge| **edge == MAYBE && touches) {
                *edge = 1.0;
                any = true;
            }
        }
        if !any {
            break;
        }
    }
    edges.iter_mut().filter(|edge| **edge == MAYBE).for_each(|edge| *edge = 0.0);
}

/// Separable Gaussian; `combine(old output, blurred)` says what is written.
fn blur(
    luma: &[f32],
    size: MapImageSize,
    sigma_px: f32,
    scratch: &mut [f32],
    out: &mut [f32],
    combine: impl Fn(f32, f32) -> f32,
) {
    let (kernel, radius) = gaussian_kernel(sigma_px);
    let MapImageSize { width, height } = size;
    for (row, target) in luma.chunks_exact(width).zip(scratch.chunks_exact_mut(width)) {
        for (x, value) in target.iter_mut().enumerate() {
            *value = kernel
                .iter()
                .enumerate()
                .take(radius + 1)
                .map(|(tap, weight)| {
                    let (left, right) = (x.saturating_sub(tap), (x + tap).min(width - 1));
                    weight * (row.get(left).unwrap_or(&0.0) + row.get(right).unwrap_or(&0.0))
                })
                .sum();
        }
    }
    for (y, target) in out.chunks_exact_mut(width).enumerate().take(height) {
        for (x, value) in target.iter_mut().enumerate() {
            let blurred = kernel
                .iter()
                .enumerate()
                .take(radius + 1)
                .map(|(tap, weight)| {
                    let (above, below) = (y.saturating_sub(tap), (y + tap).min(height - 1));
                    let at = |row: usize| scratch.get(row * width + x).copied().unwrap_or(0.0);
                    weight * (at(above) + at(below))
                })
                .sum();
            *value = combine(*value, blurred);
        }
    }
}

/// One side of a normalised kernel; the middle tap is halved because both sides read it.
fn gaussian_kernel(sigma_px: f32) -> ([f32; MAX_KERNEL_RADIUS + 1], usize) {
    let radius = (libm::ceilf(KERNEL_RADIUS_SIGMAS * sigma_px) as usize).clamp(1, MAX_KERNEL_RADIUS);
    let mut kernel = [0.0; MAX_KERNEL_RADIUS + 1];
    for (tap, weight) in kernel.iter_mut().enumerate().take(radius + 1) {
        let sigmas = tap as f32 / sigma_px;
        *weight = libm::expf(-0.5 * sigmas * sigmas) * if tap == 0 { 0.5 } else { 1.0 };
    }
    let sum: f32 = 2.0 * kernel.iter().sum::<f32>();
    kernel.iter_mut().for_each(|weight| *weight /= sum);
    (kernel, radius)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;
    use std::vec::Vec;

    const SIZE: MapImageSize = MapImageSize { width: 40, height: 30 };

    /// Dark on the left of a column, brighter by `step` on its right.
    fn found(operator: StructureOperator, step: f32) -> Vec<f32> {
        let luma: Vec<f32> = (0..SIZE.n_pixels()).map(|i| if i % SIZE.width < 20 { 0.2 } else { 0.2 + step }).collect();
        let (mut scratch, mut out) = (vec![9.0; luma.len()], vec![9.0; luma.len()]);
        find_structure(operator, (&luma, SIZE), [1.0, 1.6], &mut scratch, &mut out);
        out[15 * SIZE.width..16 * SIZE.width].to_vec()
    }

    #[test]
    fn each_operator_finds_an_edge_in_its_own_way() {
        use StructureOperator::{Canny, DifferenceOfGaussians, LaplacianOfGaussian, Random};
        for operator in [DifferenceOfGaussians, LaplacianOfGaussian] {
            let row = found(operator, 0.5);
            assert!(row[18] > 0.01 && row[21] > 0.01 && row[5] < 1e-4 && row[35] < 1e-4, "{operator:?}: {row:?}");
        }
        let edge = found(Canny, 0.5);
        assert_eq!(edge.iter().filter(|value| **value == 1.0).count(), 1, "one pixel wide: {edge:?}");
        assert!(edge[19] + edge[20] == 1.0);
        assert_eq!(found(Canny, 0.05), [0.0; 40], "what is faint is no edge");
        assert_eq!(found(Random, 0.5), [0.0; 40]);
    }

    #[test]
    fn a_faint_edge_counts_where_it_continues_a_clear_one() {
        let mut edges = vec![0.0; SIZE.n_pixels()];
        for x in 5..20 {
            edges[10 * SIZE.width + x] = MAYBE;
            edges[20 * SIZE.width + x] = MAYBE;
        }
        edges[10 * SIZE.width + 12] = 1.0;
        continue_edges(SIZE, &mut edges);
        let sum = |row: usize| edges[row * SIZE.width..(row + 1) * SIZE.width].iter().sum::<f32>();
        assert_eq!((sum(10), sum(20)), (15.0, 0.0));
    }
}
