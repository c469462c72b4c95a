//! Gradients with respect to the camera's pose, against central differences of the whole loss in f64.

use super::scenes::{K, anchors, read, view};
use super::views::{Map, loss};
use crate::seal;
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;
use kilogs_core::conventions::Rigid;
use kilogs_core::map::decoder::FEATURE_LEN;
use kilogs_core::math::{Rng, se3};
use nalgebra::{Translation3, UnitQuaternion, Vector3, Vector6};

pub const N_ANCHORS: usize = 24;
pub const EXPOSURE: Exposure = Exposure { gain: [1.1, 0.9, 1.0], bias: [0.02, -0.03, 0.0] };
const NONE: LossWeights = LossWeights { l1: 0.0, ssim: 0.0, depth: 0.0, isotropy: 0.0, exposure: 0.0 };
const L1: LossWeights = LossWeights { l1: 0.8, ..NONE };

/// A map, a view of it and what it is compared with.
pub struct Problem {
    pub map: Map,
    pub view: View,
    target: Vec<[f32; 3]>,
    depth_m: Vec<f32>,
    confidence: Vec<f32>,
}

impl Problem {
    /// Three keyframes that are moved, turned and scaled, one of which looks at the place from the side, anchors of two levels
    /// on both sides of the border between them, some beyond the picture's border where the projection is linearised elsewhere, and a sky full of waves.
    pub fn new(learned_decoder: bool) -> Self {
        let (mut headers, params) = anchors(N_ANCHORS, 77);
        for (i, header) in headers.iter_mut().enumerate() {
            header.keyframe_row = (i % 3) as u32;
            header.level = (i / 2 % 2) as u8;
            if i % 6 == 2 {
                // Seen at the border of its side.
                let [x, y, z] = header.position_in_keyframe_m;
                header.position_in_keyframe_m = [0.3 * x, 0.3 * y, 4.0 + 0.3 * (z - 4.0)];
            }
            if i % 6 == 5 {
                header.position_in_keyframe_m[0] = 0.75 * header.position_in_keyframe_m[2];
                header.log_extent = [-0.4; 3];
            }
        }
        let rotation = UnitQuaternion::from_euler_angles(0.1, 0.4, -0.2);
        let from_the_side = rotation * UnitQuaternion::from_euler_angles(0.0, 1.05, 0.0);
        let place_m = Vector3::new(30.0, -2.0, 55.0) + rotation * Vector3::new(0.0, 0.0, 20.0);
        let placements = vec![
            KeyframePlacement { rotation, translation_m: Vector3::new(30.0, -2.0, 55.0), scale: 5.0 },
            KeyframePlacement {
                rotation: UnitQuaternion::from_euler_angles(0.12, 0.38, -0.2),
                translation_m: Vector3::new(30.4, -2.1, 54.0),
                scale: 4.6,
            },
            KeyframePlacement {
                rotation: from_the_side,
                translation_m: place_m - from_the_side * Vector3::new(0.0, 0.0, 20.0),
                scale: 5.0,
            },
        ];
        let map_from_camera = Rigid::from_parts(Translation3::new(30.2, -1.9, 54.7), placements[0].rotation)
            * se3::exp(&Vector6::new(0.02, -0.03, 0.05, 0.1, 0.1, -0.2));
        let view = View { camera_from_map: map_from_camera.inverse(), ..view(53, 38) };
        let wave = |i: usize, f: f32| 0.5 + 0.4 * (i as f32 * f).sin();
        let texels = (0..BACKGROUND_TEXELS).map(|i| [wave(i, 0.9), wave(i, 0.4), wave(i, 0.021)]).collect();
        let n = view.n_pixels();
        Self {
            map: Map { k: K, headers, params, placements, texels, decoder: learned_decoder.then(decoder) },
            view,
            target: (0..n).map(|i| [wave(i, 0.31), wave(i, 0.11), wave(i, 0.05)]).collect(),
            depth_m: (0..n).map(|i| 12.0 + 9.0 * wave(i, 0.07)).collect(),
            confidence: (0..n).map(|i| (i % 4) as f32 / 3.0).collect(),
        }
    }

    pub fn training(&self) -> TrainingView<'_> {
        TrainingView {
            view: self.view,
            target: TargetImage::RgbF32(&self.target),
            depth: Some(DepthTarget { depth_m: &self.depth_m, confidence: &self.confidence }),
            exposure_slot: Some(0),
        }
    }

    /// Room for everything.
    pub fn capacities(&self) -> Capacities {
        let usual = Capacities::for_map(N_ANCHORS, K, self.view.camera.width, self.view.camera.height);
        Capacities {
            pairs: usual.pairs * 16,
            row_entries: usual.row_entries * 8,
            keyframe_rows: 3,
            learned_decoder: self.map.decoder.is_some(),
            ..usual
        }
    }

    pub fn fill(&self, backend: &mut dyn SplatBackend) {
        let Map { headers, params, placements, texels, decoder, .. } = &self.map;
        let slots: Vec<u32> = (0..N_ANCHORS as u32).collect();
        assert_eq!(backend.write_anchors(&slots, headers, params), 0);
        assert_eq!(backend.set_keyframes(0, placements), 0);
        assert!(backend.write_background(0, texels) && backend.write_exposure(0, EXPOSURE));
        if let Some((features, weights)) = decoder {
            assert_eq!(backend.write_features(&slots, features), 0);
            assert!(backend.write_decoder(0, weights));
        }
    }

    pub fn cpu(&self, level: SimdLevel, threads: usize) -> CpuBackend {
        let mut backend = CpuBackend::new(self.capacities(), threads, level, |_| ()).expect("backend");
        self.fill(&mut backend);
        backend
    }

    /// The loss after a left increment of the pose.
    fn moved(&self, weights: &LossWeights, tangent: &Vector6<f64>) -> f64 {
        let view = View { camera_from_map: se3::exp(tangent) * self.view.camera_from_map, ..self.view };
        loss(&self.map.draw(&view), &self.training(), EXPOSURE, weights)
    }

    /// By central differences; so small a step that no border of a splat meets a pixel.
    pub fn differences(&self, weights: &LossWeights) -> PoseGradient {
        const STEP: f64 = 1e-7;
        core::array::from_fn(|i| {
            let [up, down] = [STEP, -STEP].map(|step| {
                let mut tangent = Vector6::zeros();
                tangent[i] = step;
                self.moved(weights, &tangent)
            });
            (up - down) / (2.0 * STEP)
        })
    }
}

fn decoder() -> (Vec<AnchorFeature>, Vec<f32>) {
    let mut rng = Rng::new(11, 0, 0);
    let mut random = |spread: f32| spread * (2.0 * rng.unit_f32() - 1.0);
    let features = (0..N_ANCHORS).map(|_| [0; FEATURE_LEN].map(|_| random(0.5))).collect();
    (features, (0..DecoderShape::new(K).len()).map(|_| random(0.2)).collect())
}

/// Only the pose is looked for.
pub fn settings(weights: LossWeights) -> StepSettings {
    StepSettings { weights, pose_gradient: true, ..StepSettings::direct(0.0).frozen() }
}

/// Relative error of the turning and of the moving part.
pub fn errors(got: &PoseGradient, expected: &PoseGradient) -> [f64; 2] {
    [0..3, 3..6].map(|part| {
        let norm = |v: &dyn Fn(usize) -> f64| part.clone().map(|i| v(i) * v(i)).sum::<f64>().sqrt();
        norm(&|i| got[i] - expected[i]) / norm(&|i| expected[i])
    })
}

#[test]
fn pose_gradients_agree_with_differences_of_the_whole_loss() {
    let cases = [
        ("l1", L1),
        ("ssim", LossWeights { ssim: 0.2, ..NONE }),
        ("depth", LossWeights { depth: 0.01, ..NONE }),
        ("everything", LossWeights { exposure: 0.0, ..LossWeights::METHOD }),
    ];
    for learned_decoder in [false, true] {
        let problem = Problem::new(learned_decoder);
        for (what, weights) in cases {
            let expected = problem.differences(&weights);
            for level in SimdLevel::ALL.into_iter().filter(|level| level.is_available()) {
                let mut backend = problem.cpu(level, 2);
                let report = backend.train_step(&problem.training(), &settings(weights));
                assert_eq!(report.stats.overflow, Overflow::default());
                let loss = problem.moved(&weights, &Vector6::zeros());
                assert!((f64::from(report.loss.total) - loss).abs() < 1e-5 * (1.0 + loss), "{report:?}, loss {loss}");
                let got = report.pose_gradient.expect("was asked for");
                let [turn, shift] = errors(&got, &expected);
                println!("{what}, decoder {learned_decoder}, {level}: {turn:.1e}, {shift:.1e} of {expected:?}");
                assert!(
                    turn < 1e-4 && shift < 1e-4,
                    "{what}, decoder {learned_decoder}, {level}: {got:?}, {expected:?}"
                );
            }
        }
    }
}

#[test]
fn every_part_of_the_problem_is_seen() {
    let problem = Problem::new(true);
    let [all, gray] = [true, false].map(|sky| {
        let mut problem = Problem::new(true);
        if !sky {
            problem.map.texels.fill([0.5; 3]);
        }
        problem.differences(&L1)
    });
    assert!(errors(&gray, &all)[0] > 0.05, "the sky turns: {gray:?}, {all:?}");
    let direct = Problem::new(false).differences(&L1);
    assert!(errors(&direct, &all)[1] > 0.05, "the decoder is told from where: {direct:?}, {all:?}");
    let mut one_level = Problem::new(true);
    one_level.map.headers.iter_mut().for_each(|header| header.level = 0);
    assert!(errors(&one_level.differences(&L1), &all)[1] > 0.05, "levels fade");
    let drawn = problem.map.draw(&problem.view).contributions;
    let is_drawn = |slot: usize| drawn.iter().flatten().any(|(id, _)| id / K == slot);
    let shown = problem.map.headers.iter().enumerate().filter(|(slot, _)| is_drawn(*slot));
    let side_opacities = shown.map(|(_, header)| problem.map.side_opacity(header, &problem.view));
    assert!(side_opacities.filter(|opacity| (0.05..0.95).contains(opacity)).count() > 1, "sides fade");
    assert!(problem.map.draw(&problem.view).contributions.iter().flatten().count() > 1000);
}

#[test]
fn a_step_downhill_is_downhill() {
    let problem = Problem::new(false);
    let mut backend = problem.cpu(SimdLevel::best(), 2);
    let report = backend.train_step(&problem.training(), &settings(L1));
    let gradient = Vector6::from(report.pose_gradient.expect("was asked for"));
    let down = -1e-4 * gradient / gradient.norm_squared().sqrt();
    let mut training = problem.training();
    training.view.camera_from_map = se3::exp(&down) * training.view.camera_from_map;
    let after = backend.train_step(&training, &settings(L1));
    assert!(after.loss.total < report.loss.total, "{report:?}, then {after:?}");
}

#[test]
fn a_frozen_step_changes_nothing_and_a_pose_gradient_changes_no_step() {
    let problem = Problem::new(true);
    let direct = StepSettings { decoder_row: Some(0), ..StepSettings::direct(0.0) };
    let learning =
        StepSettings { rates: LearningRates { decoder: DecoderRates::METHOD, ..LearningRates::DIRECT }, ..direct };
    let state = |before: &[StepSettings]| {
        let mut backend = problem.cpu(SimdLevel::best(), 2);
        for settings in before {
            let report = backend.train_step(&problem.training(), settings);
            assert_eq!(report.pose_gradient.is_some(), settings.pose_gradient);
        }
        let mut weights = vec![0.0; DecoderShape::new(K).len()];
        assert!(backend.read_decoder(0, &mut weights));
        let loss = backend.train_step(&problem.training(), &learning).loss;
        (read(&backend), weights, backend.read_exposure(0), loss)
    };
    let plain = state(&[learning]);
    assert!(state(&[]) != plain);
    assert!(state(&[settings(L1), learning, settings(L1)]) == plain, "frozen steps");
    assert!(state(&[StepSettings { pose_gradient: true, ..learning }]) == plain, "a step with its pose gradient");
}

#[test]
fn threads_change_no_byte_and_nothing_is_allocated() {
    for learned_decoder in [false, true] {
        let problem = Problem::new(learned_decoder);
        let find = |threads: usize| {
            let mut backend = problem.cpu(SimdLevel::best(), threads);
            let training = problem.training();
            let sealed = seal::enter();
            let report = backend.train_step(&training, &settings(LossWeights::METHOD));
            assert_eq!(sealed.violations(), (0, 0));
            report.pose_gradient.map(|gradient| gradient.map(f64::to_bits))
        };
        let once = find(1);
        assert!(once.is_some());
        for threads in [1, 2, 3] {
            assert_eq!(find(threads), once, "{threads} threads");
        }
    }
}
