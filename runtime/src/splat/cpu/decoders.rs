//! The chunks' decoders, and what the optimizer remembers about them.

use super::adam::{BiasCorrection, adam};
use super::decode::{N_PARAMS, group};
use crate::splat::{Capacities, DecoderRates, DecoderShape};
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN};

/// One decoder per chunk row, or none at all.
pub struct Decoders {
    /// Where the parts of each begin.
    pub shape: DecoderShape,
    rows: Vec<Decoder>,
}

/// A decoder with its moments.
pub struct Decoder {
    shape: DecoderShape,
    /// In the layout of [`kilogs_core::map::decoder`].
    weights: Vec<f32>,
    /// `W2` as `output * HIDDEN + hidden`, then the features' part of `W1` as `hidden * FEATURE_LEN + feature`.
    transposed: Vec<f32>,
    first: Vec<f32>,
    second: Vec<f32>,
    steps: u32,
    /// `W2` and `b2` are zero.
    adds_nothing: bool,
}

/// Bytes of one chunk row.
pub const fn decoder_row_bytes(gaussians_per_anchor: usize) -> usize {
    let shape = DecoderShape::new(gaussians_per_anchor);
    size_of::<Decoder>() + (3 * shape.len() + transposed_len(shape)) * size_of::<f32>()
}

const fn transposed_len(shape: DecoderShape) -> usize {
    HIDDEN * shape.outputs + HIDDEN * FEATURE_LEN
}

/// Adam step sizes of one step.
#[derive(Clone, Copy, Debug)]
pub struct DecoderRule {
    /// Chunk row whose decoder learns.
    pub row: Option<u16>,
    /// Step size of features.
    pub feature_rate: f32,
    /// Step size of `W1` and `b1`.
    pub hidden_rate: f32,
    /// Step sizes of `W2` and `b2`, by number of a Gaussian.
    pub output_rates: [f32; N_PARAMS],
}

impl DecoderRule {
    /// Nothing learns.
    pub const FROZEN: Self = Self { row: None, feature_rate: 0.0, hidden_rate: 0.0, output_rates: [0.0; N_PARAMS] };

    /// Rates at a place in the schedule.
    pub fn at(rates: &DecoderRates, row: Option<u16>, progress: f32) -> Self {
        let mut output_rates = [0.0; N_PARAMS];
        output_rates[group::OFFSET..group::LOG_SCALE].fill(rates.offset.at(progress));
        output_rates[group::LOG_SCALE..group::ROTATION].fill(rates.log_scale.at(progress));
        output_rates[group::ROTATION..group::OPACITY].fill(rates.rotation.at(progress));
        output_rates[group::OPACITY] = rates.opacity.at(progress);
        output_rates[group::COLOR..].fill(rates.color.at(progress));
        let hidden_rate = rates.hidden.at(progress);
        let learns = hidden_rate > 0.0 || output_rates.iter().any(|&rate| rate > 0.0);
        Self { row: row.filter(|_| learns), feature_rate: rates.feature.at(progress), hidden_rate, output_rates }
    }

    /// Whether anything learns.
    pub fn is_frozen(&self) -> bool {
        self.row.is_none() && self.feature_rate <= 0.0
    }
}

impl Decoders {
    /// Decoders that add nothing and cannot learn before they are written.
    pub fn new(capacities: &Capacities) -> Self {
        let shape = DecoderShape::new(capacities.gaussians_per_anchor);
        let n_rows = if capacities.learned_decoder { capacities.chunk_rows } else { 0 };
        Self { shape, rows: (0..n_rows).map(|_| Decoder::new(shape)).collect() }
    }

    /// Whether anchors have features that are decoded.
    pub fn is_learned(&self) -> bool {
        !self.rows.is_empty()
    }

    /// Replaces a decoder and forgets its moments; false when row or length are wrong, or a number not usable.
    pub fn write(&mut self, chunk_row: u16, weights: &[f32]) -> bool {
        let fits = weights.len() == self.shape.len() && weights.iter().all(|v| v.is_finite());
        let Some(decoder) = self.rows.get_mut(usize::from(chunk_row)).filter(|_| fits) else { return false };
        decoder.weights.copy_from_slice(weights);
        decoder.first.fill(0.0);
        decoder.second.fill(0.0);
        decoder.steps = 0;
        decoder.refresh();
        true
    }

    /// Decoder of a chunk row.
    pub fn row(&self, chunk_row: u16) -> Option<&Decoder> {
        self.rows.get(usize::from(chunk_row))
    }

    /// One Adam step of the decoder that learns; `grads` are in the layout of its weights.
    pub fn step(&mut self, rule: &DecoderRule, grads: &[f32]) {
        if let Some(decoder) = rule.row.and_then(|row| self.rows.get_mut(usize::from(row))) {
            decoder.step(rule, grads);
        }
    }
}

impl Decoder {
    fn new(shape: DecoderShape) -> Self {
        let zeros = || vec![0.0; shape.len()];
        Self {
            shape,
            weights: zeros(),
            transposed: vec![0.0; transposed_len(shape)],
            first: zeros(),
            second: zeros(),
            steps: 0,
            adds_nothing: true,
        }
    }

    /// All numbers.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// Numbers of `W1` and `b1`.
    pub fn first_layer_len(&self) -> usize {
        self.shape.output_weights().start
    }

    /// Outputs of the decoder.
    pub fn outputs(&self) -> usize {
        self.shape.outputs
    }

    /// Whether every residual is 0.
    pub fn adds_nothing(&self) -> bool {
        self.adds_nothing
    }

    /// `W1`, input by input.
    pub fn hidden_weights(&self) -> &[f32] {
        &self.weights[self.shape.hidden_weights()]
    }

    /// The part of `W1` that reads from where an anchor is seen, input by input.
    pub fn view_weights(&self) -> &[f32] {
        &self.hidden_weights()[FEATURE_LEN * HIDDEN..]
    }

    /// `b1`.
    pub fn hidden_bias(&self) -> &[f32] {
        &self.weights[self.shape.hidden_bias()]
    }

    /// `W2`, hidden unit by hidden unit.
    pub fn output_weights(&self) -> &[f32] {
        &self.weights[self.shape.output_weights()]
    }

    /// `b2`.
    pub fn output_bias(&self) -> &[f32] {
        &self.weights[self.shape.output_bias()]
    }

    /// `W2`, output by output.
    pub fn output_weights_transposed(&self) -> &[f32] {
        &self.transposed[..HIDDEN * self.shape.outputs]
    }

    /// The features' part of `W1`, hidden unit by hidden unit.
    pub fn feature_weights_transposed(&self) -> &[f32] {
        &self.transposed[HIDDEN * self.shape.outputs..]
    }

    fn step(&mut self, rule: &DecoderRule, grads: &[f32]) {
        self.steps = self.steps.saturating_add(1);
        let correction = BiasCorrection::at(f64::from(self.steps));
        let first_layer = self.shape.output_weights().start;
        let moments = self.first.iter_mut().zip(&mut self.second);
        for (i, ((weight, (first, second)), &grad)) in self.weights.iter_mut().zip(moments).zip(grads).enumerate() {
            let rate = match i.checked_sub(first_layer) {
                None => rule.hidden_rate,
                Some(output) => rule.output_rates[output % N_PARAMS],
            };
            if rate <= 0.0 {
                continue;
            }
            let (m, v) = (f64::from(*first), f64::from(*second));
            let [value, m, v] = adam(f64::from(*weight), m, v, f64::from(grad), f64::from(rate), &correction);
            (*weight, *first, *second) = (value as f32, m as f32, v as f32);
        }
        self.refresh();
    }

    /// Brings what is derived from the weights up to date.
    fn refresh(&mut self) {
        let outputs = self.shape.outputs;
        let (by_output, by_hidden) = self.transposed.split_at_mut(HIDDEN * outputs);
        transpose(&self.weights[self.shape.output_weights()], outputs, by_output);
        let feature_rows = &self.weights[..FEATURE_LEN * HIDDEN];
        transpose(feature_rows, HIDDEN, by_hidden);
        self.adds_nothing = self.weights[self.shape.output_weights().start..].iter().all(|&v| v == 0.0);
    }
}

/// Rows of `row_len` become columns.
pub fn transpose(rows: &[f32], row_len: usize, columns: &mut [f32]) {
    let n_rows = rows.len() / row_len.max(1);
    for (r, row) in rows.chunks_exact(row_len.max(1)).enumerate() {
        for (c, &value) in row.iter().enumerate() {
            columns[c * n_rows + r] = value;
        }
    }
}
