//! The learned decoder of a chunk: what it adds to the stored numbers of an anchor's Gaussians.
//!
//! A Gaussian that is drawn has the 14 numbers `stored + residual`, where, for the k Gaussians of an anchor at once,
//! `residual = W2 relu(W1 x + b1) + b2` and `x` is, in this order, the anchor's 32 features, the unit direction from
//! the camera to the anchor in the axes of the anchor's keyframe, and the logarithm of that distance
//! ([`view_input`]). After Lu et al. 2024, sec. 3.2, as a residual (method.md 8): zero `W2` and `b2` change nothing.
//!
//! A decoder is one slice of numbers, in this order (see [`DecoderShape`]):
//!
//! | part | numbers | at |
//! |---|---|---|
//! | `W1` | [`INPUTS`] x [`HIDDEN`] | `input * HIDDEN + hidden` |
//! | `b1` | [`HIDDEN`] | `hidden` |
//! | `W2` | [`HIDDEN`] x outputs | `hidden * outputs + output` |
//! | `b2` | outputs | `output = gaussian * 14 + number` |
//!
//! `number` counts the fields of [`GaussianParams`] in their order. Sums go over ascending
//! inputs, respectively hidden units, and begin with the bias.

use super::anchor::{GAUSSIAN_PARAMS, GaussianParams};
pub use super::numbers::{FEATURE_LEN, HIDDEN, INPUTS, VIEW_INPUTS};
use super::numbers::{LOG2_DISTANCE_UNIT, LOG2_MIDDLE_DISTANCE, MIN_DISTANCE_M};
use crate::math::Rng;
use core::ops::{Add, Mul, Range};

/// What an anchor tells its decoder; 0 at first.
pub type AnchorFeature = [f32; FEATURE_LEN];

/// A feature of nothing.
pub const NO_FEATURE: AnchorFeature = [0.0; FEATURE_LEN];

/// The inputs that depend on the camera; `anchor_from_camera_m` is in the axes and units of the anchor's keyframe.
#[inline]
pub fn view_input(anchor_from_camera_m: [f32; 3]) -> [f32; VIEW_INPUTS] {
    let [x, y, z] = anchor_from_camera_m;
    let distance_m = libm::sqrtf(x * x + y * y + z * z).max(MIN_DISTANCE_M);
    let log_distance = (libm::log2f(distance_m) - LOG2_MIDDLE_DISTANCE) / LOG2_DISTANCE_UNIT;
    [x / distance_m, y / distance_m, z / distance_m, log_distance]
}

/// Gradient with respect to `anchor_from_camera_m`, from that with respect to its [`view_input`].
pub fn view_input_backward(anchor_from_camera_m: [f32; 3], grads: &[f32; VIEW_INPUTS]) -> [f32; 3] {
    let [x, y, z] = anchor_from_camera_m;
    let length_m = libm::sqrtf(x * x + y * y + z * z);
    let distance_m = length_m.max(MIN_DISTANCE_M);
    let unit = anchor_from_camera_m.map(|v| v / distance_m);
    let [gx, gy, gz, by_log] = *grads;
    let [ux, uy, uz] = unit;
    // Below the smallest distance nothing is divided by the length.
    let along = if length_m > MIN_DISTANCE_M {
        gx * ux + gy * uy + gz * uz - by_log / (LOG2_DISTANCE_UNIT * core::f32::consts::LN_2)
    } else {
        0.0
    };
    [(gx - ux * along) / distance_m, (gy - uy * along) / distance_m, (gz - uz * along) / distance_m]
}

/// Numbers of a decoder and where each part begins.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DecoderShape {
    /// `14 k`.
    pub outputs: usize,
}

impl DecoderShape {
    /// Decoder of anchors with so many Gaussians.
    pub const fn new(gaussians_per_anchor: usize) -> Self {
        Self { outputs: gaussians_per_anchor * GAUSSIAN_PARAMS }
    }

    /// Numbers of the whole decoder.
    pub const fn len(&self) -> usize {
        INPUTS * HIDDEN + HIDDEN + HIDDEN * self.outputs + self.outputs
    }

    /// Never.
    pub const fn is_empty(&self) -> bool {
        false
    }

    /// `W1`.
    pub const fn hidden_weights(&self) -> Range<usize> {
        0..INPUTS * HIDDEN
    }

    /// `b1`.
    pub const fn hidden_bias(&self) -> Range<usize> {
        let start = self.hidden_weights().end;
        start..start + HIDDEN
    }

    /// `W2`.
    pub const fn output_weights(&self) -> Range<usize> {
        let start = self.hidden_bias().end;
        start..start + HIDDEN * self.outputs
    }

    /// `b2`.
    pub const fn output_bias(&self) -> Range<usize> {
        let start = self.output_weights().end;
        start..start + self.outputs
    }
}

/// Purpose of the draws here (see [`Rng::new`]).
const INITIAL_WEIGHTS: u64 = 0x6465_636f;

/// Fills a fresh decoder, which changes nothing yet: `W1` He-uniform (He et al. 2015, eq. 10), `b1` uniform within
/// `1 / sqrt(inputs)`, `W2` and `b2` zero. False when `weights` has another length.
pub fn fill_fresh_decoder(shape: DecoderShape, run_seed: u64, chunk: u32, weights: &mut [f32]) -> bool {
    if weights.len() != shape.len() {
        return false;
    }
    let mut rng = Rng::new(run_seed, u64::from(chunk), INITIAL_WEIGHTS);
    let weight_bound = libm::sqrtf(6.0 / INPUTS as f32);
    let bias_bound = libm::sqrtf(1.0 / INPUTS as f32);
    for (i, weight) in weights.iter_mut().enumerate() {
        let bound = match i {
            i if i < shape.hidden_weights().end => weight_bound,
            i if i < shape.hidden_bias().end => bias_bound,
            _ => 0.0,
        };
        *weight = if bound > 0.0 { bound * (2.0 * rng.unit_f32() - 1.0) } else { 0.0 };
    }
    true
}

/// `f32`, or `f64` for checks against finite differences.
pub trait Number: Copy + Default + PartialOrd + Add<Output = Self> + Mul<Output = Self> {}

impl Number for f32 {}
impl Number for f64 {}

/// `hidden = relu(W1 input + b1)` and `residual = W2 hidden + b2`; slices that do not fit the shape leave the rest out.
pub fn decode_residual<T: Number>(
    shape: DecoderShape,
    weights: &[T],
    input: &[T; INPUTS],
    hidden: &mut [T; HIDDEN],
    residual: &mut [T],
) {
    let part = |range: Range<usize>| weights.get(range).unwrap_or_default();
    let (w1, b1) = (part(shape.hidden_weights()), part(shape.hidden_bias()));
    let (w2, b2) = (part(shape.output_weights()), part(shape.output_bias()));
    for (unit, bias) in hidden.iter_mut().zip(b1) {
        *unit = *bias;
    }
    for (&x, row) in input.iter().zip(w1.chunks_exact(HIDDEN)) {
        for (unit, &weight) in hidden.iter_mut().zip(row) {
            *unit = *unit + weight * x;
        }
    }
    for unit in hidden.iter_mut() {
        *unit = relu(*unit);
    }
    for (out, bias) in residual.iter_mut().zip(b2) {
        *out = *bias;
    }
    for (&unit, row) in hidden.iter().zip(w2.chunks_exact(shape.outputs.max(1))) {
        for (out, &weight) in residual.iter_mut().zip(row) {
            *out = *out + weight * unit;
        }
    }
}

/// Gradients through [`decode_residual`], whose `hidden` is handed in: those of the weights are added to
/// `weight_grads`, those of the inputs replace `input_grads`.
pub fn decode_residual_backward<T: Number>(
    shape: DecoderShape,
    weights: &[T],
    (input, hidden): (&[T; INPUTS], &[T; HIDDEN]),
    residual_grads: &[T],
    weight_grads: &mut [T],
    input_grads: &mut [T; INPUTS],
) {
    let part = |range: Range<usize>| weights.get(range).unwrap_or_default();
    let (w1, w2) = (part(shape.hidden_weights()), part(shape.output_weights()));
    let Some((first_layer, second_layer)) = weight_grads.split_at_mut_checked(shape.output_weights().start) else {
        return;
    };
    let Some((w1_grads, b1_grads)) = first_layer.split_at_mut_checked(shape.hidden_bias().start) else { return };
    let Some((w2_grads, b2_grads)) = second_layer.split_at_mut_checked(shape.output_weights().len()) else { return };
    let outputs = shape.outputs.max(1);
    let mut hidden_grads = [T::default(); HIDDEN];
    let rows = w2.chunks_exact(outputs).zip(w2_grads.chunks_exact_mut(outputs));
    for ((hidden_grad, &unit), (row, row_grads)) in hidden_grads.iter_mut().zip(hidden).zip(rows) {
        let mut sum = T::default();
        for ((&weight, weight_grad), &grad) in row.iter().zip(row_grads).zip(residual_grads) {
            sum = sum + weight * grad;
            *weight_grad = *weight_grad + unit * grad;
        }
        if unit > T::default() {
            *hidden_grad = sum;
        }
    }
    for (bias_grad, &grad) in b2_grads.iter_mut().zip(residual_grads) {
        *bias_grad = *bias_grad + grad;
    }
    for (bias_grad, &grad) in b1_grads.iter_mut().zip(&hidden_grads) {
        *bias_grad = *bias_grad + grad;
    }
    let rows = w1.chunks_exact(HIDDEN).zip(w1_grads.chunks_exact_mut(HIDDEN));
    for ((input_grad, &x), (row, row_grads)) in input_grads.iter_mut().zip(input).zip(rows) {
        let mut sum = T::default();
        for ((&weight, weight_grad), &grad) in row.iter().zip(row_grads).zip(&hidden_grads) {
            sum = sum + weight * grad;
            *weight_grad = *weight_grad + x * grad;
        }
        *input_grad = sum;
    }
}

/// What a decoder adds to an anchor seen from the centre of the keyframe that spawned it: where something has to stand
/// for all views at once.
pub fn residual_at_spawn(
    shape: DecoderShape,
    weights: &[f32],
    feature: &AnchorFeature,
    position_in_keyframe_m: [f32; 3],
    residual: &mut [f32],
) {
    let mut input = [0.0; INPUTS];
    let numbers = feature.iter().copied().chain(view_input(position_in_keyframe_m));
    input.iter_mut().zip(numbers).for_each(|(input, number)| *input = number);
    decode_residual(shape, weights, &input, &mut [0.0; HIDDEN], residual);
}

/// A Gaussian with its part of a residual added; parts that are missing add nothing.
pub fn with_residual(params: &GaussianParams, residual: &[f32]) -> GaussianParams {
    let mut numbers: [f32; GAUSSIAN_PARAMS] = zerocopy::transmute!(*params);
    numbers.iter_mut().zip(residual).for_each(|(number, residual)| *number += residual);
    zerocopy::transmute!(numbers)
}

fn relu<T: Number>(value: T) -> T {
    if value > T::default() { value } else { T::default() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;
    use std::vec::Vec;

    const SHAPE: DecoderShape = DecoderShape::new(2);

    struct Problem {
        weights: Vec<f64>,
        input: [f64; INPUTS],
        upstream: Vec<f64>,
    }

    fn problem(seed: u64) -> Problem {
        let mut rng = Rng::new(seed, 1, 2);
        let mut random = || 2.0 * rng.unit_f64() - 1.0;
        Problem {
            weights: (0..SHAPE.len()).map(|_| random()).collect(),
            input: [0; INPUTS].map(|_| random()),
            upstream: (0..SHAPE.outputs).map(|_| random()).collect(),
        }
    }

    impl Problem {
        fn value(&self) -> f64 {
            let (mut hidden, mut residual) = ([0.0; HIDDEN], vec![0.0; SHAPE.outputs]);
            decode_residual(SHAPE, &self.weights, &self.input, &mut hidden, &mut residual);
            residual.iter().zip(&self.upstream).map(|(r, u)| r * u).sum()
        }

        fn gradients(&self) -> (Vec<f64>, [f64; INPUTS]) {
            let (mut hidden, mut residual) = ([0.0; HIDDEN], vec![0.0; SHAPE.outputs]);
            decode_residual(SHAPE, &self.weights, &self.input, &mut hidden, &mut residual);
            let (mut weights, mut inputs) = (vec![0.0; SHAPE.len()], [0.0; INPUTS]);
            let forward = (&self.input, &hidden);
            decode_residual_backward(SHAPE, &self.weights, forward, &self.upstream, &mut weights, &mut inputs);
            (weights, inputs)
        }
    }

    #[test]
    fn gradients_agree_with_differences() {
        const STEP: f64 = 1e-6;
        let mut problem = problem(7);
        let (weights, inputs) = problem.gradients();
        let check = |what: &str, i: usize, got: f64, up: f64, down: f64| {
            let difference = (up - down) / (2.0 * STEP);
            assert!((got - difference).abs() < 1e-7, "{what} {i}: {got}, by differences {difference}");
        };
        for (i, &got) in weights.iter().enumerate() {
            let mut moved = |step: f64| {
                problem.weights[i] += step;
                let value = problem.value();
                problem.weights[i] -= step;
                value
            };
            let (up, down) = (moved(STEP), moved(-STEP));
            check("weight", i, got, up, down);
        }
        for (i, &got) in inputs.iter().enumerate() {
            let mut moved = |step: f64| {
                problem.input[i] += step;
                let value = problem.value();
                problem.input[i] -= step;
                value
            };
            let (up, down) = (moved(STEP), moved(-STEP));
            check("input", i, got, up, down);
        }
    }

    #[test]
    fn gradients_of_the_place_of_the_camera_agree_with_differences() {
        let upstream = [0.7f32, -0.4, 0.3, 0.9];
        for (from_camera_m, step_m) in
            [([3.0f32, -2.0, 20.0], 0.05f32), ([-0.5, 0.2, 0.1], 2e-3), ([0.02, 0.05, 0.01], 1e-3)]
        {
            let value = |at: [f32; 3]| view_input(at).iter().zip(upstream).map(|(v, u)| f64::from(v * u)).sum::<f64>();
            let got = view_input_backward(from_camera_m, &upstream);
            for i in 0..3 {
                let moved = |step_m: f32| {
                    let mut at = from_camera_m;
                    at[i] += step_m;
                    value(at)
                };
                let difference = (moved(step_m) - moved(-step_m)) / f64::from(2.0 * step_m);
                let error = (f64::from(got[i]) - difference).abs();
                assert!(error < 1e-3 * (1e-2 + difference.abs()), "{from_camera_m:?} {i}: {} by {difference}", got[i]);
            }
        }
    }

    #[test]
    fn a_fresh_decoder_changes_nothing_and_can_learn() {
        let mut weights = vec![f32::NAN; SHAPE.len()];
        assert!(fill_fresh_decoder(SHAPE, 3, 0, &mut weights));
        let mut input = [0.0; INPUTS];
        input[FEATURE_LEN..].copy_from_slice(&view_input([1.0, -2.0, 20.0]));
        let (mut hidden, mut residual) = ([0.0; HIDDEN], vec![f32::NAN; SHAPE.outputs]);
        decode_residual(SHAPE, &weights, &input, &mut hidden, &mut residual);
        assert_eq!(residual, vec![0.0; SHAPE.outputs]);
        let awake = hidden.iter().filter(|&&unit| unit > 0.0).count();
        assert!((8..=24).contains(&awake), "{awake} of {HIDDEN} units pass a gradient on");

        let mut other = vec![0.0; SHAPE.len()];
        assert!(fill_fresh_decoder(SHAPE, 3, 1, &mut other) && other != weights, "chunks differ");
        assert!(fill_fresh_decoder(SHAPE, 3, 0, &mut other) && other == weights, "a seed repeats");
        assert!(!fill_fresh_decoder(SHAPE, 3, 0, &mut other[1..]), "another length");
    }

    #[test]
    fn a_residual_is_added_number_by_number() {
        let params = GaussianParams {
            offset: [0.0; 3],
            log_scale: [10.0; 3],
            quaternion_xyzw: [20.0; 4],
            opacity_logit: 30.0,
            color_logit: [40.0; 3],
        };
        let residual: [f32; GAUSSIAN_PARAMS] = core::array::from_fn(|i| i as f32);
        let expected = GaussianParams {
            offset: [0.0, 1.0, 2.0],
            log_scale: [13.0, 14.0, 15.0],
            quaternion_xyzw: [26.0, 27.0, 28.0, 29.0],
            opacity_logit: 40.0,
            color_logit: [51.0, 52.0, 53.0],
        };
        assert_eq!(with_residual(&params, &residual), expected);
        assert_eq!(with_residual(&params, &[]), params);
    }

    #[test]
    fn directions_are_unit_and_distances_logarithmic() {
        for (from_camera_m, expected) in [
            ([0.0, 0.0, 16.0], [0.0, 0.0, 1.0, 0.0]),
            ([-128.0, 0.0, 0.0], [-1.0, 0.0, 0.0, 1.0]),
            ([0.0, 2.0, 0.0], [0.0, 1.0, 0.0, -1.0]),
            ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, -7.0 / 3.0]),
        ] {
            let got = view_input(from_camera_m);
            assert!(got.iter().zip(expected).all(|(g, e)| (g - e).abs() < 1e-6), "{from_camera_m:?}: {got:?}");
        }
    }
}
