//! The learned decoder in the backend: against the mathematics of `core`, and what it must not change.

use super::compare::{compare_gradients, compare_pictures};
use super::scenes::{K, anchors, read, render, view};
use crate::seal;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;
use kilogs_core::map::decoder::{
    FEATURE_LEN, HIDDEN, INPUTS, decode_residual, decode_residual_backward, fill_fresh_decoder, view_input,
};
use kilogs_core::math::Rng;
use zerocopy::{FromBytes, IntoBytes};

pub const SHAPE: DecoderShape = DecoderShape::new(K);
const N_ANCHORS: usize = 61;

pub struct Scene {
    pub view: View,
    pub headers: Vec<AnchorHeader>,
    pub params: Vec<GaussianParams>,
    pub features: Vec<AnchorFeature>,
    /// One per chunk row.
    pub decoders: [Vec<f32>; 2],
}

/// Anchors of two chunk rows in turn, with random features and decoders.
fn scene() -> Scene {
    scene_of(N_ANCHORS)
}

/// The same with so many anchors.
pub fn scene_of(n_anchors: usize) -> Scene {
    let (mut headers, params) = anchors(n_anchors, 21);
    for (i, header) in headers.iter_mut().enumerate() {
        header.chunk_row = u16::from(i % 7 > 3);
    }
    let mut rng = Rng::new(5, 0, 0);
    let mut random = |spread: f32| spread * (2.0 * rng.unit_f32() - 1.0);
    let features = (0..n_anchors).map(|_| [0; FEATURE_LEN].map(|_| random(0.5))).collect();
    let mut decoder = || (0..SHAPE.len()).map(|_| random(0.25)).collect::<Vec<f32>>();
    let decoders = [decoder(), decoder()];
    Scene { view: view(80, 52), headers, params, features, decoders }
}

impl Scene {
    pub fn capacities(&self, learned_decoder: bool) -> Capacities {
        let usual = Capacities::for_map(self.headers.len(), K, self.view.camera.width, self.view.camera.height);
        Capacities {
            pairs: usual.pairs * 8,
            row_entries: usual.row_entries * 4,
            chunk_rows: 2,
            learned_decoder,
            ..usual
        }
    }

    /// Anchors, features and decoders.
    pub fn fill(&self, backend: &mut dyn SplatBackend) {
        let slots: Vec<u32> = (0..self.headers.len() as u32).collect();
        assert_eq!(backend.write_anchors(&slots, &self.headers, &self.params), 0);
        assert_eq!(backend.write_features(&slots, &self.features), 0);
        assert!((0..2u16).zip(&self.decoders).all(|(row, weights)| backend.write_decoder(row, weights)));
    }

    fn backend(&self, learned_decoder: bool, level: SimdLevel, threads: usize) -> CpuBackend {
        let mut backend = CpuBackend::new(self.capacities(learned_decoder), threads, level, |_| ()).expect("backend");
        assert_eq!(backend.write_anchors(&slots(), &self.headers, &self.params), 0);
        backend
    }

    /// With features and decoders.
    fn learned(&self, level: SimdLevel, threads: usize) -> CpuBackend {
        let mut backend = self.backend(true, level, threads);
        self.fill(&mut backend);
        backend
    }

    /// The camera is where the keyframe is.
    fn inputs(&self, anchor: usize) -> [f32; INPUTS] {
        let mut inputs = [0.0; INPUTS];
        inputs[..FEATURE_LEN].copy_from_slice(&self.features[anchor]);
        inputs[FEATURE_LEN..].copy_from_slice(&view_input(self.headers[anchor].position_in_keyframe_m));
        inputs
    }

    fn decoder(&self, anchor: usize) -> &[f32] {
        &self.decoders[usize::from(self.headers[anchor].chunk_row)]
    }

    /// The Gaussians with what the mathematics of `core` adds.
    fn decoded(&self) -> Vec<GaussianParams> {
        let mut numbers = <[f32]>::ref_from_bytes(self.params.as_bytes()).expect("numbers").to_vec();
        for (anchor, numbers) in numbers.chunks_exact_mut(SHAPE.outputs).enumerate() {
            let (mut hidden, mut residual) = ([0.0; HIDDEN], [0.0; K * N_PARAMS]);
            decode_residual(SHAPE, self.decoder(anchor), &self.inputs(anchor), &mut hidden, &mut residual);
            numbers.iter_mut().zip(residual).for_each(|(number, residual)| *number += residual);
        }
        <[GaussianParams]>::ref_from_bytes(numbers.as_bytes()).expect("Gaussians").to_vec()
    }
}

fn slots() -> Vec<u32> {
    (0..N_ANCHORS as u32).collect()
}

fn levels() -> impl Iterator<Item = SimdLevel> {
    SimdLevel::ALL.into_iter().filter(|level| level.is_available())
}

pub fn target(view: &View) -> Vec<[f32; 3]> {
    let wave = |i: usize, f: f32| 0.5 + 0.4 * (i as f32 * f).sin();
    (0..view.n_pixels()).map(|i| [wave(i, 0.31), wave(i, 0.11), wave(i, 0.05)]).collect()
}

pub fn training<'a>(view: &View, target: &'a [[f32; 3]]) -> TrainingView<'a> {
    TrainingView { view: *view, target: TargetImage::RgbF32(target), depth: None, exposure_slot: None }
}

pub fn learning(decoder: DecoderRates) -> StepSettings {
    let direct = StepSettings::direct(0.0);
    StepSettings { rates: LearningRates { decoder, ..direct.rates }, decoder_row: Some(0), ..direct }
}

#[test]
fn what_is_drawn_is_the_stored_numbers_plus_the_residual() {
    let scene = scene();
    for level in levels() {
        let mut learned = scene.learned(level, 2);
        let mut direct = scene.backend(false, level, 2);
        let stored = render(&mut direct, &scene.view);
        assert_eq!(direct.write_anchors(&slots(), &scene.headers, &scene.decoded()), 0);
        let (got, expected) = (render(&mut learned, &scene.view), render(&mut direct, &scene.view));
        let compare = |expected: &super::scenes::Picture| {
            compare_pictures(got.rgb.as_flattened(), expected.rgb.as_flattened(), 1e-4, 0.002)
        };
        assert_eq!(compare(&expected), Ok(()), "{level}");
        assert!(compare(&stored).is_err(), "{level}: the residual can be seen");
    }
}

#[test]
fn gradients_are_those_of_the_mathematics() {
    let scene = scene();
    let target = target(&scene.view);
    for (level, row) in levels().flat_map(|level| [(level, 0u16), (level, 1)]) {
        let mut backend = scene.learned(level, 2);
        let settings = StepSettings { decoder_row: Some(row), ..learning(DecoderRates::METHOD) };
        let mut params = vec![[f32::NAN; N_PARAMS]; N_ANCHORS * K];
        let mut features = vec![[f32::NAN; FEATURE_LEN]; N_ANCHORS];
        let training = training(&scene.view, &target);
        let found = backend.decoder_gradients(&training, &settings, &mut params, &mut features).expect("fits");
        let weights = found.1.to_vec();

        let mut expected_weights = vec![0.0f64; SHAPE.len()];
        let mut expected_features = Vec::new();
        for (anchor, grads) in params.chunks_exact(K).enumerate() {
            let grads: Vec<f64> = grads.as_flattened().iter().map(|&g| f64::from(g)).collect();
            let decoder: Vec<f64> = scene.decoder(anchor).iter().map(|&w| f64::from(w)).collect();
            let inputs = scene.inputs(anchor).map(f64::from);
            let (mut hidden, mut residual) = ([0.0; HIDDEN], [0.0; K * N_PARAMS]);
            decode_residual(SHAPE, &decoder, &inputs, &mut hidden, &mut residual);
            let (mut own, mut input_grads) = (vec![0.0; SHAPE.len()], [0.0; INPUTS]);
            decode_residual_backward(SHAPE, &decoder, (&inputs, &hidden), &grads, &mut own, &mut input_grads);
            expected_features.extend(input_grads[..FEATURE_LEN].iter().map(|&g| g as f32));
            if scene.headers[anchor].chunk_row == row {
                expected_weights.iter_mut().zip(own).for_each(|(sum, own)| *sum += own);
            }
        }
        let expected_weights: Vec<f32> = expected_weights.iter().map(|&g| g as f32).collect();
        for (what, range) in [
            ("W1", SHAPE.hidden_weights()),
            ("b1", SHAPE.hidden_bias()),
            ("W2", SHAPE.output_weights()),
            ("b2", SHAPE.output_bias()),
        ] {
            let result = compare_gradients(&weights[range.clone()], &expected_weights[range], 1e-4);
            assert!(result.is_ok(), "{level}, row {row}, {what}: {result:?}");
        }
        let result = compare_gradients(features.as_flattened(), &expected_features, 1e-4);
        assert!(result.is_ok(), "{level}, features: {result:?}");
    }
}

#[test]
fn a_frozen_decoder_that_adds_nothing_changes_no_byte() {
    let scene = scene();
    let target = target(&scene.view);
    let state = |learned: bool| {
        let mut backend = scene.backend(learned, SimdLevel::best(), 2);
        if learned {
            let mut fresh = vec![0.0; SHAPE.len()];
            assert!(fill_fresh_decoder(SHAPE, 1, 0, &mut fresh) && backend.write_decoder(0, &fresh));
        }
        let settings = StepSettings::direct(0.0);
        let reports: Vec<StepReport> =
            (0..5).map(|_| backend.train_step(&training(&scene.view, &target), &settings)).collect();
        (reports, read(&backend), render(&mut backend, &scene.view))
    };
    assert!(state(true) == state(false));
}

#[test]
fn threads_and_repetition_change_no_byte() {
    let scene = scene();
    let target = target(&scene.view);
    let state = |threads: usize| {
        let mut backend = scene.learned(SimdLevel::best(), threads);
        let settings = learning(DecoderRates::METHOD);
        let report = (0..5).map(|_| backend.train_step(&training(&scene.view, &target), &settings)).last();
        let mut features = scene.features.clone();
        let mut decoders = scene.decoders.clone();
        assert_eq!(backend.read_features(&slots(), &mut features), 0);
        assert!((0..2u16).zip(&mut decoders).all(|(row, weights)| backend.read_decoder(row, weights)));
        (report, features, decoders, read(&backend))
    };
    let once = state(1);
    assert!(once.1 != scene.features, "features learn");
    assert!(once.2[0] != scene.decoders[0], "the decoder of the step's row learns");
    assert!(once.2[1] == scene.decoders[1], "the others are frozen");
    for threads in [1, 2, 3] {
        assert!(state(threads) == once, "{threads} threads differ from one");
    }
}

#[test]
fn a_fresh_decoder_learns_and_a_frozen_head_does_not() {
    let scene = scene();
    let target = render(&mut scene.learned(SimdLevel::best(), 2), &scene.view).rgb;
    let mut backend = scene.backend(true, SimdLevel::best(), 2);
    let mut fresh = vec![0.0; SHAPE.len()];
    assert!(fill_fresh_decoder(SHAPE, 1, 0, &mut fresh));
    assert!(backend.write_decoder(0, &fresh) && backend.write_decoder(1, &fresh));
    let frozen = LearningRate::constant(0.0);
    let decoder = DecoderRates { offset: frozen, ..DecoderRates::METHOD };
    let direct = LearningRates {
        offset: frozen,
        log_scale: frozen,
        rotation: frozen,
        opacity: frozen,
        color: frozen,
        background: frozen,
        exposure: frozen,
        decoder,
    };
    // Nothing but the picture: the pull towards round Gaussians is not what is to be learned here.
    let weights = LossWeights { isotropy: 0.0, ..LossWeights::METHOD };
    let settings = StepSettings { rates: direct, weights, ..learning(decoder) };
    let mut step = || backend.train_step(&training(&scene.view, &target), &settings).loss.mse;
    let first = step();
    let last = (0..100).map(|_| step()).last().expect("100 steps");
    println!("mse {first} to {last}");
    assert!(last < 0.8 * first, "mse {first} to {last}");
    assert!(read(&backend) == scene.params, "stored numbers are frozen");
    let (mut features, mut weights) = (scene.features.clone(), vec![f32::NAN; SHAPE.len()]);
    assert_eq!(backend.read_features(&slots(), &mut features), 0);
    assert!(features.as_flattened().iter().any(|v| v.abs() > 0.01));
    assert!(backend.read_decoder(0, &mut weights));
    for (i, weight) in weights[SHAPE.output_weights().start..].iter().enumerate() {
        let is_offset = i % N_PARAMS < 3;
        assert!(!is_offset || *weight == 0.0, "output {i} of the frozen head is {weight}");
    }
    assert!(weights[SHAPE.output_bias()].iter().any(|w| w.abs() > 0.01));
}

#[test]
fn what_cannot_be_decoded_is_refused_at_the_door() {
    let scene = scene();
    let mut backend = scene.learned(SimdLevel::best(), 1);
    let mut weights = scene.decoders[0].clone();
    assert!(!backend.write_decoder(2, &weights), "no such row");
    assert!(!backend.write_decoder(0, &weights[1..]), "another length");
    assert!(!backend.read_decoder(0, &mut weights[1..]));
    weights[7] = f32::NAN;
    assert!(!backend.write_decoder(0, &weights), "no number");
    let mut feature = scene.features[0];
    assert_eq!(backend.write_features(&[N_ANCHORS as u32], &[feature]), 1, "no such slot");
    feature[3] = f32::INFINITY;
    assert_eq!(backend.write_features(&[0], &[feature]), 1, "no number");
    assert_eq!(backend.read_features(&[0, N_ANCHORS as u32], &mut [feature; 2]), 1);

    let mut direct = scene.backend(false, SimdLevel::best(), 1);
    assert!(!direct.write_decoder(0, &scene.decoders[0]) && !direct.read_decoder(0, &mut weights));
    assert_eq!(direct.write_features(&[0], &scene.features[..1]), 1);

    backend.write_anchors(&[0], &scene.headers[..1], &scene.params[..K]);
    let mut features = [scene.features[0]];
    assert_eq!(backend.read_features(&[0], &mut features), 0);
    assert_eq!(features, [[0.0; FEATURE_LEN]], "an anchor that is written begins without a feature");
}

#[test]
fn learning_allocates_nothing() {
    let scene = scene();
    let target = target(&scene.view);
    let mut backend = scene.learned(SimdLevel::best(), 2);
    let sealed = seal::enter();
    for _ in 0..3 {
        backend.train_step(&training(&scene.view, &target), &learning(DecoderRates::METHOD));
        backend.write_features(&[3], &scene.features[..1]);
        backend.write_decoder(1, &scene.decoders[0]);
    }
    assert_eq!(sealed.violations(), (0, 0));
}
