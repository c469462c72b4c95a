//! A scene that is known is found again from a perturbed start.

use super::scenes::{anchors, backend, render, view};
use crate::splat::cpu::CpuBackend;
use crate::splat::*;

/// Steps of the fit.
const STEPS: usize = 150;
/// The fit must gain at least this much, dB.
const GAIN_DB: f32 = 8.0;

fn perturbed(params: &[GaussianParams]) -> Vec<GaussianParams> {
    let noise = |i: usize, a: usize| (((i * 31 + a * 17) % 23) as f32 / 11.0 - 1.0) * 0.4;
    let mut params = params.to_vec();
    for (i, gaussian) in params.iter_mut().enumerate() {
        for a in 0..3 {
            gaussian.offset[a] += noise(i, a);
            gaussian.log_scale[a] += noise(i, a + 3);
            gaussian.color_logit[a] += 2.0 * noise(i, a + 6);
        }
        gaussian.opacity_logit += 2.0 * noise(i, 9);
    }
    params
}

fn psnr_db(report: &StepReport) -> f32 {
    -10.0 * report.loss.mse.log10()
}

/// First and last report of a fit to a scene's own picture, and the backend.
fn fit(threads: usize, steps: usize) -> (StepReport, StepReport, CpuBackend) {
    let view = view(80, 52);
    let (headers, params) = anchors(60, 11);
    let picture = render(&mut backend(&view, &headers, &params, threads), &view);
    let mut backend = backend(&view, &headers, &perturbed(&params), threads);
    let confidence = vec![1.0; view.n_pixels()];
    let training = TrainingView {
        view,
        target: TargetImage::RgbF32(&picture.rgb),
        depth: Some(DepthTarget { depth_m: &picture.depth_m, confidence: &confidence }),
        exposure_slot: Some(0),
    };
    let mut step = |i: usize| backend.train_step(&training, &StepSettings::direct(i as f32 / STEPS as f32));
    let first = step(0);
    let last = (1..steps).map(&mut step).last().unwrap_or(first);
    (first, last, backend)
}

#[test]
fn a_perturbed_scene_is_found_again() {
    let (first, last, _) = fit(2, STEPS);
    let gain_db = psnr_db(&last) - psnr_db(&first);
    println!("psnr {} -> {} dB, ssim {} -> {}", psnr_db(&first), psnr_db(&last), first.loss.ssim, last.loss.ssim);
    assert!(gain_db > GAIN_DB, "gained {gain_db} dB: {first:?} to {last:?}");
    assert!(last.loss.ssim > first.loss.ssim && last.loss.depth < first.loss.depth, "{first:?} to {last:?}");
}

#[test]
fn threads_and_repetition_change_no_byte() {
    let state = |threads: usize| {
        let (first, last, mut backend) = fit(threads, 6);
        let mut texels = vec![[0.0; 3]; BACKGROUND_TEXELS];
        assert!(backend.read_background(0, &mut texels));
        let picture = render(&mut backend, &view(80, 52));
        (first, last, super::scenes::read(&backend), texels, picture)
    };
    let once = state(1);
    for threads in [1, 2, 3] {
        let again = state(threads);
        assert!(again == once, "{threads} threads differ from one: {:?} and {:?}", again.1, once.1);
    }
}

#[test]
fn exposure_is_learned_and_pulled_to_identity() {
    let view = view(40, 30);
    let (headers, params) = anchors(30, 3);
    let picture = render(&mut backend(&view, &headers, &params, 1), &view);
    let brighter: Vec<[f32; 3]> = picture.rgb.iter().map(|rgb| rgb.map(|v| 1.2 * v)).collect();
    let mut backend = backend(&view, &headers, &params, 1);
    let training = TrainingView { view, target: TargetImage::RgbF32(&brighter), depth: None, exposure_slot: Some(0) };
    let mut settings = StepSettings::direct(0.0);
    let frozen = LearningRate::constant(0.0);
    settings.rates = LearningRates {
        offset: frozen,
        log_scale: frozen,
        rotation: frozen,
        opacity: frozen,
        color: frozen,
        background: frozen,
        exposure: LearningRate::constant(0.005),
        decoder: DecoderRates::FROZEN,
    };
    for _ in 0..200 {
        backend.train_step(&training, &settings);
    }
    let gain = backend.read_exposure(0).expect("slot 0").gain;
    assert!(gain.iter().all(|g| (1.1..1.25).contains(g)), "{gain:?}");
    settings.weights = LossWeights { l1: 0.0, ssim: 0.0, depth: 0.0, isotropy: 0.0, exposure: 1.0 };
    for _ in 0..200 {
        backend.train_step(&training, &settings);
    }
    let gain = backend.read_exposure(0).expect("slot 0").gain;
    assert!(gain.iter().all(|g| (g - 1.0).abs() < 0.02), "{gain:?}");
}
