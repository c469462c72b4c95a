//! The learned decoder on the devices against the CPU backend.

use super::devices::{Device, on_every_device};
use crate::seal;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::cpu::tests::compare::{compare_gradients, compare_pictures};
use crate::splat::cpu::tests::decoder::{SHAPE, Scene, learning, scene_of, target, training};
use crate::splat::cpu::tests::scenes::{K, Picture, anchors, render};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::kernel_constants::DECODER_PIECES;
use crate::splat::program::{Buffer, FEATURE_MOMENTS};
use crate::splat::vulkan::VALIDATION_VARIABLE;
use crate::splat::*;
use kilogs_core::map::decoder::{FEATURE_LEN, NO_FEATURE};
use nalgebra::{UnitQuaternion, Vector3};
use zerocopy::IntoBytes;

/// A keyframe that is neither where the camera is, nor turned or scaled like it.
fn moved_keyframe(scale: f64) -> KeyframePlacement {
    KeyframePlacement {
        rotation: UnitQuaternion::from_euler_angles(0.1, -0.2, 0.3),
        translation_m: Vector3::new(0.4, -0.2, 0.9),
        scale,
    }
}

/// Anchors of two chunk rows that are learned, before a keyframe that has moved; a third row that nothing was written to.
struct Problem {
    scene: Scene,
    capacities: Capacities,
    target: Vec<[f32; 3]>,
    keyframe_scale: f64,
}

impl Problem {
    fn new(n_anchors: usize) -> Self {
        let scene = scene_of(n_anchors);
        let capacities = Capacities { chunk_rows: 3, ..scene.capacities(true) };
        let target = target(&scene.view);
        Self { scene, capacities, target, keyframe_scale: 1.3 }
    }

    fn fill(&self, backend: &mut dyn SplatBackend) {
        self.scene.fill(backend);
        assert_eq!(backend.set_keyframes(0, &[moved_keyframe(self.keyframe_scale)]), 0);
        assert!(backend.write_background(0, &[[0.4; 3]; BACKGROUND_TEXELS]));
    }

    fn cpu(&self) -> CpuBackend {
        let mut backend = CpuBackend::new(self.capacities, 1, SimdLevel::best(), |_| ()).expect("backend");
        self.fill(&mut backend);
        backend
    }

    fn training(&self) -> TrainingView<'_> {
        training(&self.scene.view, &self.target)
    }

    /// Gradients of the CPU backend.
    fn expected(&self, settings: &StepSettings) -> Gradients {
        let n = self.scene.headers.len();
        let (mut params, mut features) = (vec![[0.0; N_PARAMS]; n * K], vec![NO_FEATURE; n]);
        let mut cpu = self.cpu();
        let found = cpu.decoder_gradients(&self.training(), settings, &mut params, &mut features).expect("fits");
        Gradients { weights: found.1.to_vec(), params, features: features.as_flattened().to_vec() }
    }

    /// Those of a device: the mean gradients after the first step are a tenth of the gradients.
    fn found(&self, backend: &mut dyn Device, settings: &StepSettings) -> Gradients {
        self.fill(backend);
        let params = backend.training_gradients(&self.training(), settings).params;
        let report = backend.train_step(&self.training(), settings);
        assert!(!report.stats.refused);
        let ten_times = |words: &[u32]| words.iter().map(|&word| 10.0 * f32::from_bits(word)).collect::<Vec<f32>>();
        let n = self.scene.headers.len();
        let moments = backend.words(Buffer::FeatureMoments, n * FEATURE_MOMENTS);
        let features = moments.chunks(FEATURE_MOMENTS).flat_map(|moments| ten_times(&moments[..FEATURE_LEN])).collect();
        let row = usize::from(settings.decoder_row.expect("a row learns"));
        let first = backend.words(Buffer::DecoderFirst, (row + 1) * SHAPE.len());
        Gradients { params, features, weights: ten_times(&first[row * SHAPE.len()..]) }
    }
}

struct Gradients {
    params: Vec<[f32; N_PARAMS]>,
    features: Vec<f32>,
    weights: Vec<f32>,
}

impl Gradients {
    /// Whether each kind of gradient agrees with what is expected, by name.
    fn compare(&self, expected: &Self) -> Vec<(&'static str, bool)> {
        let result = |what, got: &[f32], expected: &[f32]| {
            let result = compare_gradients(got, expected, 1e-4);
            println!("{what}: {result:?}");
            (what, result.is_ok())
        };
        let part =
            |what, range: core::ops::Range<usize>| result(what, &self.weights[range.clone()], &expected.weights[range]);
        vec![
            result("params", self.params.as_flattened(), expected.params.as_flattened()),
            result("features", &self.features, &expected.features),
            part("W1", SHAPE.hidden_weights()),
            part("b1", SHAPE.hidden_bias()),
            part("W2", SHAPE.output_weights()),
            part("b2", SHAPE.output_bias()),
        ]
    }
}

#[test]
fn pictures_match_the_cpu() {
    let problem = Problem::new(61);
    let expected = render(&mut problem.cpu(), &problem.scene.view);
    let stored = {
        let mut cpu = problem.cpu();
        let zeros = vec![0.0; problem.scene.decoders[0].len()];
        assert!(cpu.write_decoder(0, &zeros) && cpu.write_decoder(1, &zeros));
        render(&mut cpu, &problem.scene.view)
    };
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let got = render(backend, &problem.scene.view);
        let compare =
            |expected: &Picture| compare_pictures(got.rgb.as_flattened(), expected.rgb.as_flattened(), 1e-4, 0.002);
        assert_eq!(compare(&expected), Ok(()), "{who}");
        assert_eq!(got.stats, expected.stats, "{who}");
        assert!(compare(&stored).is_err(), "{who}: the residual can be seen");
    });
}

#[test]
fn gradients_match_the_cpu() {
    // A few anchors, and so many that every sum takes more than one round.
    for (n_anchors, row) in [(61, 0), (61, 1), (6000, 1)] {
        let problem = Problem::new(n_anchors);
        let settings = StepSettings { decoder_row: Some(row), ..learning(DecoderRates::METHOD) };
        let expected = problem.expected(&settings);
        on_every_device(problem.capacities, |who, backend| {
            for (what, is_same) in problem.found(backend, &settings).compare(&expected) {
                assert!(is_same, "{what} of {n_anchors} anchors with row {row} on {who}");
            }
        });
    }
}

#[test]
fn a_wrong_reference_is_caught() {
    let problem = Problem::new(61);
    let settings = learning(DecoderRates::METHOD);
    // The anchors are seen from elsewhere.
    let expected = Problem { keyframe_scale: 1.6, ..Problem::new(61) }.expected(&settings);
    on_every_device(problem.capacities, |who, backend| {
        for (what, is_same) in problem.found(backend, &settings).compare(&expected) {
            assert!(!is_same, "{what} on {who} do not depend on where the camera is");
        }
    });
}

/// All trained numbers of Gaussians, features and decoders.
fn trained(backend: &dyn SplatBackend) -> [Vec<f32>; 3] {
    let capacities = backend.capacities();
    let slots: Vec<u32> = (0..capacities.anchors as u32).collect();
    let (mut headers, mut params) = anchors(slots.len(), 0);
    let mut features = vec![NO_FEATURE; slots.len()];
    let mut decoders = vec![0.0; capacities.chunk_rows * SHAPE.len()];
    assert_eq!(backend.read_anchors(&slots, &mut headers, &mut params), 0);
    assert_eq!(backend.read_features(&slots, &mut features), 0);
    assert!((0..).zip(decoders.chunks_mut(SHAPE.len())).all(|(row, weights)| backend.read_decoder(row, weights)));
    let numbers = params.as_bytes().as_chunks().0.iter().map(|&bytes| f32::from_le_bytes(bytes));
    [numbers.collect(), features.as_flattened().to_vec(), decoders]
}

#[test]
fn ten_steps_end_where_the_cpu_ends() {
    let problem = Problem::new(61);
    let settings = StepSettings { progress: 0.3, ..learning(DecoderRates::METHOD) };
    on_every_device(problem.capacities, |who, backend| {
        let mut cpu = problem.cpu();
        problem.fill(backend);
        let before = trained(backend);
        for step in 0..10 {
            let expected = cpu.train_step(&problem.training(), &settings);
            let got = backend.train_step(&problem.training(), &settings);
            let error = (got.loss.total - expected.loss.total).abs();
            assert!(error < 1e-5 * expected.loss.total, "step {step} with {who}: {got:?}, expected {expected:?}");
        }
        let (after, expected) = (trained(backend), trained(&cpu));
        for (i, what) in ["params", "features", "decoders"].into_iter().enumerate() {
            let result = compare_gradients(&after[i], &expected[i], 1e-4);
            println!("{who} {what} after ten steps: {result:?}");
            assert!(result.is_ok(), "{what} with {who}: {result:?}");
            assert!(after[i] != before[i], "{what} with {who} are trained");
        }
        assert!(after[2][SHAPE.len()..] == before[2][SHAPE.len()..], "{who}: decoders of other rows are frozen");
    });
}

#[test]
fn a_frozen_decoder_is_drawn_and_not_changed() {
    let problem = Problem::new(61);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let before = trained(backend);
        let report = backend.train_step(&problem.training(), &StepSettings::direct(0.0));
        assert!(!report.stats.refused, "{who}");
        let after = trained(backend);
        assert!(after[0] != before[0] && after[1..] == before[1..], "{who}");
    });
}

#[test]
fn two_runs_are_the_same_bytes() {
    let problem = Problem::new(1000);
    let run = || {
        let mut out = Vec::new();
        on_every_device(problem.capacities, |_, backend| {
            problem.fill(backend);
            let steps = (0..3).map(|_| backend.train_step(&problem.training(), &learning(DecoderRates::METHOD)));
            let reports: Vec<StepReport> = steps.collect();
            out.push((reports, trained(backend).map(|numbers| numbers.as_bytes().to_vec())));
        });
        out
    };
    assert!(run() == run(), "two runs of three steps differ");
}

#[test]
fn what_nothing_was_written_to_is_untouched() {
    const SENTINEL: u32 = 0xdead_beef;
    let mut problem = Problem::new(61);
    let (n_slots, n_rows) = (problem.capacities.anchors, problem.capacities.chunk_rows);
    problem.capacities.anchors += 10;
    // By slot, by chunk row: how many are used.
    let rows = |words| (words, 2, n_rows);
    let buffers = [
        (Buffer::Features, (FEATURE_LEN, n_slots, n_slots + 10)),
        (Buffer::FeatureMoments, (FEATURE_MOMENTS, n_slots, n_slots + 10)),
        (Buffer::Decoders, rows(SHAPE.len())),
        (Buffer::DecoderFirst, rows(SHAPE.len())),
        (Buffer::DecoderSecond, rows(SHAPE.len())),
        (Buffer::DecoderSums, (SHAPE.len(), DECODER_PIECES as usize, DECODER_PIECES as usize)),
    ];
    on_every_device(problem.capacities, |who, backend| {
        for (buffer, (words, _, n)) in buffers {
            backend.set_words(buffer, &vec![SENTINEL; n * words]);
        }
        problem.fill(backend);
        let report = backend.train_step(&problem.training(), &learning(DecoderRates::METHOD));
        assert!(!report.stats.refused && report.loss.total.is_finite(), "{who}: {report:?}");
        for (buffer, (words, used, n)) in buffers {
            let found = backend.words(buffer, n * words);
            assert!(found[..used * words].iter().all(|&word| word != SENTINEL), "{who}: {buffer:?} is not filled");
            assert!(found[used * words..].iter().all(|&word| word == SENTINEL), "{who}: {buffer:?} is overrun");
        }
    });
}

#[test]
fn moments_restart_with_what_they_belong_to() {
    let problem = Problem::new(61);
    let zeros = |words: Vec<u32>| words.iter().all(|&word| word == 0);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        backend.train_step(&problem.training(), &learning(DecoderRates::METHOD));
        let once = trained(backend);
        assert!(!zeros(backend.words(Buffer::FeatureMoments, FEATURE_MOMENTS * 61)), "{who}");
        problem.fill(backend);
        for (buffer, n) in [
            (Buffer::FeatureMoments, FEATURE_MOMENTS * 61),
            (Buffer::DecoderFirst, SHAPE.len()),
            (Buffer::DecoderSecond, SHAPE.len()),
        ] {
            assert!(zeros(backend.words(buffer, n)), "{who}: {buffer:?} is kept");
        }
        backend.train_step(&problem.training(), &learning(DecoderRates::METHOD));
        assert!(trained(backend)[1..] == once[1..], "{who}: steps of decoders are kept");
    });
}

#[test]
fn what_cannot_be_decoded_is_refused_at_the_door() {
    let problem = Problem::new(61);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let before = trained(backend);
        let mut weights = problem.scene.decoders[0].clone();
        assert!(!backend.write_decoder(3, &weights), "{who}: no such row");
        assert!(
            !backend.write_decoder(0, &weights[1..]) && !backend.read_decoder(0, &mut weights[1..]),
            "{who}: length"
        );
        weights[7] = f32::NAN;
        assert!(!backend.write_decoder(0, &weights), "{who}: no number");
        let mut feature = problem.scene.features[0];
        assert_eq!(backend.write_features(&[61], &[feature]), 1, "{who}: no such slot");
        feature[3] = f32::INFINITY;
        assert_eq!(backend.write_features(&[0], &[feature]), 1, "{who}: no number");
        assert_eq!(backend.read_features(&[0, 61], &mut [feature; 2]), 1, "{who}");
        assert!(trained(backend) == before, "{who} was changed");
        backend.write_anchors(&[0], &problem.scene.headers[..1], &problem.scene.params[..K]);
        assert_eq!(backend.read_features(&[0], core::slice::from_mut(&mut feature)), 0);
        assert_eq!(feature, NO_FEATURE, "{who}: an anchor that is written begins without a feature");
    });
    let direct = Capacities { learned_decoder: false, ..problem.capacities };
    on_every_device(direct, |who, backend| {
        let mut weights = problem.scene.decoders[0].clone();
        assert!(!backend.write_decoder(0, &weights) && !backend.read_decoder(0, &mut weights), "{who}");
        assert_eq!(backend.write_features(&[0], &problem.scene.features[..1]), 1, "{who}");
        assert_eq!(backend.read_features(&[0], &mut [NO_FEATURE]), 1, "{who}");
    });
}

#[test]
fn learning_on_vulkan_allocates_nothing() {
    let problem = Problem::new(61);
    // The validation layer allocates on this thread while it watches.
    let is_watched = std::env::var_os(VALIDATION_VARIABLE).is_some();
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let mut step = || backend.train_step(&problem.training(), &learning(DecoderRates::METHOD));
        step();
        let sealed = seal::enter();
        let is_refused = (0..3).any(|_| step().stats.refused);
        let violations = sealed.violations();
        drop(sealed);
        assert!(!is_refused, "{who}");
        assert!(who != "vulkan" || is_watched || violations == (0, 0), "{violations:?}");
    });
}
