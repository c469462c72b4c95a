//! A decoder's layers for a batch of anchors. Lanes are the units of a layer: weights are read as they lie, and no
//! anchor has to be turned sideways.

use super::decoders::Decoder;
use super::lane::{Lane, Wide};
use crate::splat::capacity::MAX_GAUSSIANS_PER_ANCHOR;
use kilogs_core::map::anchor::GAUSSIAN_PARAMS;
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN, INPUTS};
use pulp::Simd;

/// Anchors that share one pass over the weights: as many sums as hide the latency of a fused multiplication.
pub const BATCH: usize = 8;

/// Most outputs that a decoder has.
pub const MAX_OUTPUTS: usize = MAX_GAUSSIANS_PER_ANCHOR * GAUSSIAN_PARAMS;

/// Numbers of one layer for each anchor of a batch.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Layer<const N: usize>(pub [[f32; N]; BATCH]);

impl<const N: usize> Layer<N> {
    /// Zeros.
    pub const ZERO: Self = Self([[0.0; N]; BATCH]);
}

/// `relu(W1 x + b1)`, see [`kilogs_core::map::decoder::decode_residual`].
#[inline(always)]
pub fn hidden_layer<S: Simd>(simd: S, decoder: &Decoder, inputs: &Layer<INPUTS>, hidden: &mut Layer<HIDDEN>) {
    let zero = Wide::splat(simd, 0.0);
    for first in (0..HIDDEN).step_by(S::F32_LANES) {
        let bias = Wide::load(simd, &decoder.hidden_bias()[first..]);
        let sums = multiply(simd, bias, inputs, decoder.hidden_weights(), HIDDEN, first);
        for a in 0..BATCH {
            sums[a].max(zero).store(&mut hidden.0[a][first..]);
        }
    }
}

/// Outputs `first..` of `W2 h + b2`; lanes beyond the last output hold anything.
#[inline(always)]
pub fn outputs<S: Simd>(simd: S, decoder: &Decoder, hidden: &Layer<HIDDEN>, first: usize) -> [Wide<S>; BATCH] {
    let bias = Wide::load(simd, &decoder.output_bias()[first..]);
    multiply(simd, bias, hidden, decoder.output_weights(), decoder.outputs(), first)
}

/// Gradients of the hidden units `first..` before the rectifier, from those of the outputs.
#[inline(always)]
pub fn hidden_grads<S: Simd>(
    simd: S,
    decoder: &Decoder,
    output_grads: &Layer<MAX_OUTPUTS>,
    hidden: &Layer<HIDDEN>,
    first: usize,
) -> [Wide<S>; BATCH] {
    let zero = Wide::splat(simd, 0.0);
    let mut sums = multiply(simd, zero, output_grads, decoder.output_weights_transposed(), HIDDEN, first);
    for a in 0..BATCH {
        let unit = Wide::load(simd, &hidden.0[a][first..]);
        sums[a] = zero.replace(zero.lt(unit), sums[a]);
    }
    sums
}

/// Gradients of the features `first..`, from those of the hidden units.
#[inline(always)]
pub fn feature_grads<S: Simd>(
    simd: S,
    decoder: &Decoder,
    hidden_grads: &Layer<HIDDEN>,
    first: usize,
) -> [Wide<S>; BATCH] {
    let zero = Wide::splat(simd, 0.0);
    multiply(simd, zero, hidden_grads, decoder.feature_weights_transposed(), FEATURE_LEN, first)
}

/// `start + sum_j factors[a][j] * rows[j][first..]` for every anchor a; rows follow each other without a gap.
#[inline(always)]
fn multiply<S: Simd, const N: usize>(
    simd: S,
    start: Wide<S>,
    factors: &Layer<N>,
    rows: &[f32],
    row_len: usize,
    first: usize,
) -> [Wide<S>; BATCH] {
    let n_rows = (rows.len() / row_len).min(N);
    let mut sums = [start; BATCH];
    for j in 0..n_rows {
        let weights = Wide::load(simd, &rows[j * row_len + first..]);
        for a in 0..BATCH {
            sums[a] = Wide::splat(simd, factors.0[a][j]).mul_add(weights, sums[a]);
        }
    }
    sums
}

/// Adds `sum_a left[a][j] * right[a]` to the lanes `first..` of row j, rows being [`HIDDEN`] long.
#[inline(always)]
pub fn add_products<S: Simd, const N: usize>(
    simd: S,
    left: &Layer<N>,
    right: &[Wide<S>; BATCH],
    rows: &mut [f32],
    first: usize,
) {
    let n_rows = (rows.len() / HIDDEN).min(N);
    for j in 0..n_rows {
        let row = &mut rows[j * HIDDEN + first..];
        let mut sum = Wide::load(simd, row);
        for a in 0..BATCH {
            sum = Wide::splat(simd, left.0[a][j]).mul_add(right[a], sum);
        }
        sum.store(row);
    }
}
