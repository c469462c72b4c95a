//! The lane mathematics: SIMD against the library, and gradients in f64 against central differences.

use crate::splat::cpu::decode::{AnchorLanes, Decoded, N_PARAMS, decode, decode_backward};
use crate::splat::cpu::lane::{Lane, Wide};
use crate::splat::cpu::project::{
    CameraConstants, CameraFromKeyframe, Projected, SplatGradient, project, project_backward,
};
use crate::splat::cpu::simd::{Dispatch, SimdLevel};
use crate::splat::cpu::update::anisotropy;
use kilogs_core::map::DecoderShape;
use kilogs_core::map::decoder::{HIDDEN, INPUTS, decode_residual, decode_residual_backward};
use kilogs_core::math::rng::Rng;
use pulp::{Simd, WithSimd};

struct Exp2<'a>(&'a mut [f32]);

impl WithSimd for Exp2<'_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        for chunk in self.0.chunks_mut(S::F32_LANES) {
            Wide::load(simd, chunk).exp2().store(chunk);
        }
    }
}

#[test]
fn exp2_agrees_with_the_library_on_every_level() {
    let inputs: Vec<f32> = (-125_990..127_000).step_by(7).map(|i| i as f32 * 1e-3).collect();
    for level in SimdLevel::ALL {
        let Some(dispatch) = Dispatch::new(level) else { continue };
        let mut got = inputs.clone();
        dispatch.run(Exp2(&mut got));
        for (&x, &y) in inputs.iter().zip(&got) {
            let error = f64::from(y) / f64::from(x).exp2() - 1.0;
            assert!(error.abs() < 3e-7, "{level}: 2^{x} = {y}, relative error {error:e}");
        }
        let mut ends = [-1e30, 1e30, 0.0];
        dispatch.run(Exp2(&mut ends));
        assert_eq!(ends, [2f32.powi(-126), 2f32.powi(127), 1.0], "{level}");
    }
}

const CAMERA: CameraConstants =
    CameraConstants { focal_px: [60.0, 64.0], center_px: [30.0, 20.0], min_z1: [-0.65, -0.45], max_z1: [0.6, 0.4] };

struct Case {
    anchor: AnchorLanes<f64>,
    placement: CameraFromKeyframe<f64>,
    params: [f64; N_PARAMS],
    /// Random direction in the space of everything that a splat consists of.
    upstream: SplatGradient<f64>,
}

/// `beyond` moves the mean so far to the side that the linearisation point is clamped.
fn case(seed: u64, beyond: bool) -> Case {
    let mut rng = Rng::new(seed, 0, 0);
    let mut random = |spread: f64| spread * (2.0 * rng.unit_f64() - 1.0);
    let rotation = nalgebra::UnitQuaternion::from_euler_angles(random(0.3), random(0.3), random(0.3));
    let matrix = rotation.to_rotation_matrix().into_inner() * 1.3;
    let linear = [0, 1, 2].map(|r| [0, 1, 2].map(|c| matrix[(r, c)]));
    let side_m = if beyond { 4.0 } else { 0.0 };
    Case {
        anchor: AnchorLanes { position: [random(0.5), random(0.5), random(0.5)], extent: [0.5, 0.4, 0.6] },
        placement: CameraFromKeyframe { linear, translation: [side_m, random(0.3), 4.0] },
        params: core::array::from_fn(|_| random(0.8)),
        upstream: SplatGradient {
            mean_px: [random(1.0), random(1.0)],
            conic: [random(30.0), random(30.0), random(30.0)],
            opacity: random(1.0),
            color: [random(1.0), random(1.0), random(1.0)],
            depth: random(1.0),
        },
    }
}

impl Case {
    fn decoded(&self, params: &[f64; N_PARAMS]) -> Decoded<f64> {
        decode(&self.anchor, params)
    }

    fn value(&self, params: &[f64; N_PARAMS]) -> f64 {
        let g = self.decoded(params);
        let p = project(&CAMERA, &self.placement, &g);
        let u = &self.upstream;
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
        dot(&p.mean_px, &u.mean_px)
            + dot(&p.conic, &u.conic)
            + dot(&g.color, &u.color)
            + g.opacity * u.opacity
            + p.depth_m * u.depth
    }

    fn gradient(&self, params: &[f64; N_PARAMS]) -> [f64; N_PARAMS] {
        let g = self.decoded(params);
        let p = project(&CAMERA, &self.placement, &g);
        let grad = project_backward(&CAMERA, &self.placement, &g, &p, &self.upstream);
        decode_backward(&self.anchor, params, &g, &grad.gaussian)
    }
}

#[test]
fn decoding_and_projection_agree_with_differences() {
    const STEP: f64 = 1e-6;
    for (seed, beyond) in (0..20).map(|seed| (seed, seed % 4 == 0)) {
        let case = case(seed, beyond);
        let gradient = case.gradient(&case.params);
        let norm = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
        for i in 0..N_PARAMS {
            let moved = |step: f64| {
                let mut params = case.params;
                params[i] += step;
                case.value(&params)
            };
            let difference = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            let error = (difference - gradient[i]).abs() / norm;
            assert!(error < 1e-7, "seed {seed}, number {i}: {} by differences {difference}", gradient[i]);
        }
    }
}

/// Gaussians per anchor of the chain below.
const K: usize = 2;
const SHAPE: DecoderShape = DecoderShape::new(K);

/// An anchor on its way through decoder, decoding and projection.
struct Chain {
    gaussians: [Case; K],
    weights: Vec<f64>,
    inputs: [f64; INPUTS],
}

impl Chain {
    fn new(seed: u64) -> Self {
        let mut rng = Rng::new(seed, 0, 1);
        let mut random = |spread: f64| spread * (2.0 * rng.unit_f64() - 1.0);
        Self {
            gaussians: core::array::from_fn(|i| case(seed + i as u64, false)),
            weights: (0..SHAPE.len()).map(|_| random(0.2)).collect(),
            inputs: [0; INPUTS].map(|_| random(1.0)),
        }
    }

    fn hidden_and_drawn(&self) -> ([f64; HIDDEN], [[f64; N_PARAMS]; K]) {
        let (mut hidden, mut residual) = ([0.0; HIDDEN], [[0.0; N_PARAMS]; K]);
        decode_residual(SHAPE, &self.weights, &self.inputs, &mut hidden, residual.as_flattened_mut());
        (hidden, core::array::from_fn(|g| core::array::from_fn(|i| self.gaussians[g].params[i] + residual[g][i])))
    }

    fn value(&self) -> f64 {
        let (_, drawn) = self.hidden_and_drawn();
        self.gaussians.iter().zip(&drawn).map(|(gaussian, params)| gaussian.value(params)).sum()
    }

    /// Of the stored numbers, the decoder and its inputs.
    fn gradients(&self) -> ([[f64; N_PARAMS]; K], Vec<f64>, [f64; INPUTS]) {
        let (hidden, drawn) = self.hidden_and_drawn();
        let params: [[f64; N_PARAMS]; K] = core::array::from_fn(|g| self.gaussians[g].gradient(&drawn[g]));
        let (mut weights, mut inputs) = (vec![0.0; SHAPE.len()], [0.0; INPUTS]);
        let forward = (&self.inputs, &hidden);
        let upstream = params.as_flattened();
        decode_residual_backward(SHAPE, &self.weights, forward, upstream, &mut weights, &mut inputs);
        (params, weights, inputs)
    }

    /// Every number that is trained, or an input of the decoder, in turn.
    fn number(&mut self, i: usize) -> &mut f64 {
        let Self { gaussians, weights, inputs } = self;
        let params = gaussians.iter_mut().flat_map(|gaussian| &mut gaussian.params);
        params.chain(weights).chain(inputs).nth(i).expect("a number")
    }
}

#[test]
fn the_whole_chain_with_the_decoder_agrees_with_differences() {
    const STEP: f64 = 1e-6;
    for seed in 0..3 {
        let mut chain = Chain::new(seed);
        let (params, weights, inputs) = chain.gradients();
        let gradient: Vec<f64> = params.as_flattened().iter().chain(&weights).chain(&inputs).copied().collect();
        let norm = gradient.iter().map(|g| g * g).sum::<f64>().sqrt();
        for (i, &got) in gradient.iter().enumerate() {
            let mut moved = |step: f64| {
                let old = *chain.number(i);
                *chain.number(i) = old + step;
                let value = chain.value();
                *chain.number(i) = old;
                value
            };
            let difference = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
            let error = (difference - got).abs() / norm;
            assert!(error < 1e-7, "seed {seed}, number {i}: {got} by differences {difference}");
        }
    }
}

/// A needle of 50 m at a distance of 1 m, across the diagonal of the picture.
struct ProjectNeedle;

impl WithSimd for ProjectNeedle {
    type Output = [f32; 3];
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        let mut out = [0.0; 3];
        let projected = needle(Wide::splat(simd, 0.0));
        for (out, lanes) in out.iter_mut().zip(projected.conic) {
            lanes.store(core::slice::from_mut(out));
        }
        out
    }
}

#[inline(always)]
fn needle<L: Lane>(zero: L) -> Projected<L> {
    let (sin, cos) = (std::f64::consts::FRAC_PI_8.sin(), std::f64::consts::FRAC_PI_8.cos());
    let one = zero.constant(1.0);
    let gaussian = Decoded {
        mean: [zero.constant(0.1), zero.constant(-0.1), one],
        rotation: [zero, zero, zero.constant(sin), zero.constant(cos)],
        scale: [zero.constant(50.0), zero.constant(1e-3), zero.constant(1e-3)],
        opacity: one,
        color: [one; 3],
    };
    let identity = [[one, zero, zero], [zero, one, zero], [zero, zero, one]];
    project(&CAMERA, &CameraFromKeyframe { linear: identity, translation: [zero; 3] }, &gaussian)
}

#[test]
fn a_needle_keeps_its_width_in_single_precision() {
    let expected = needle(0.0f64).conic;
    for dispatch in SimdLevel::ALL.into_iter().filter_map(Dispatch::new) {
        let got = dispatch.run(ProjectNeedle);
        for (got, expected) in got.iter().zip(expected) {
            assert!((f64::from(*got) / expected - 1.0).abs() < 1e-3, "{got}, expected {expected}");
        }
    }
}

#[test]
fn anisotropy_agrees_with_differences_and_is_zero_for_a_ball() {
    assert_eq!(anisotropy(&[0.7f64, 0.7, 0.7]).0, 0.0);
    let at = [0.1f64, -0.4, 0.5];
    for i in 0..3 {
        let moved = |step: f64| {
            let mut log_scale = at;
            log_scale[i] += step;
            anisotropy(&log_scale).0
        };
        let difference = (moved(1e-6) - moved(-1e-6)) / 2e-6;
        assert!((difference - anisotropy(&at).1[i]).abs() < 1e-8, "scale {i}");
    }
}
