//! Gradients of the whole training loss against central differences of the loss itself, in f32.

use super::compare::compare_gradients;
use super::reference::ssim;
use super::scenes::{K, anchors, backend, read, render, view};
use crate::splat::cpu::CpuBackend;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::*;
use zerocopy::{FromBytes, IntoBytes};

const FROZEN: LearningRate = LearningRate::constant(0.0);
const NO_RATES: LearningRates = LearningRates {
    offset: FROZEN,
    log_scale: FROZEN,
    rotation: FROZEN,
    opacity: FROZEN,
    color: FROZEN,
    background: FROZEN,
    exposure: FROZEN,
    decoder: DecoderRates::FROZEN,
};
const NONE: LossWeights = LossWeights { l1: 0.0, ssim: 0.0, depth: 0.0, isotropy: 0.0, exposure: 0.0 };

const EXPOSURE: Exposure = Exposure { gain: [1.1, 0.9, 1.0], bias: [0.02, -0.03, 0.0] };

struct Problem {
    backend: CpuBackend,
    headers: Vec<AnchorHeader>,
    view: View,
    target: Vec<[f32; 3]>,
    depth_m: Vec<f32>,
    confidence: Vec<f32>,
    settings: StepSettings,
}

impl Problem {
    fn new(weights: LossWeights) -> Self {
        let view = view(37, 26);
        let (headers, params) = anchors(6, 5);
        let backend = backend(&view, &headers, &params, 2);
        let n = view.n_pixels();
        // Farther than anything drawn, so that absolute values have no kink on the way.
        let offset = if weights.l1 != 0.0 { 1.5 } else { 0.0 };
        let wave = |i: usize, f: f32| offset + 0.5 + 0.4 * (i as f32 * f).sin();
        let target = (0..n).map(|i| [wave(i, 0.31), wave(i, 0.11), wave(i, 0.05)]).collect();
        let confidence = (0..n).map(|i| (i % 4) as f32 / 3.0).collect();
        let settings = StepSettings {
            rates: NO_RATES,
            progress: 0.0,
            weights,
            decoder_row: None,
            finished: ChunkRows::NONE,
            pose_gradient: false,
        };
        Self { backend, headers, view, target, depth_m: vec![50.0; n], confidence, settings }
    }

    /// The loss by its equations, from what the backend draws.
    fn loss(&mut self) -> f64 {
        let weights = self.settings.weights;
        let picture = render(&mut self.backend, &self.view);
        assert_eq!(picture.stats.overflow, Overflow::default());
        let exposure = self.backend.read_exposure(0).expect("slot 0");
        let n = picture.rgb.len() as f64;
        let mut loss = 0.0;
        for channel in 0..3 {
            let (gain, bias) = (f64::from(exposure.gain[channel]), f64::from(exposure.bias[channel]));
            let x: Vec<f64> = picture.rgb.iter().map(|rgb| gain * f64::from(rgb[channel]) + bias).collect();
            let y: Vec<f64> = self.target.iter().map(|rgb| f64::from(rgb[channel])).collect();
            let l1 = x.iter().zip(&y).map(|(x, y)| (x - y).abs()).sum::<f64>() / n;
            loss += f64::from(weights.l1) * l1 / 3.0;
            if weights.ssim != 0.0 {
                loss += f64::from(weights.ssim) * (1.0 - ssim(&x, &y, self.view.camera.width as usize)) / 3.0;
            }
        }
        let confident: f64 = self.confidence.iter().map(|&c| f64::from(c)).sum();
        let depths = picture.depth_m.iter().zip(&self.depth_m).zip(&self.confidence);
        let depth: f64 =
            depths.map(|((d, target), c)| f64::from(*c) * (f64::from(*d) - f64::from(*target)).abs()).sum();
        loss + f64::from(weights.depth) * depth / confident
    }

    /// The loss as the backend reports it.
    fn reported_loss(&mut self) -> LossTerms {
        let Self { backend, view, target, depth_m, confidence, settings, .. } = self;
        let training = TrainingView {
            view: *view,
            target: TargetImage::RgbF32(target),
            depth: Some(DepthTarget { depth_m, confidence }),
            exposure_slot: Some(0),
        };
        backend.train_step(&training, settings).loss
    }

    fn gradients(&mut self) -> (Vec<[f32; N_PARAMS]>, Vec<[f32; 3]>) {
        let mut params = vec![[f32::NAN; N_PARAMS]; self.headers.len() * K];
        let Self { backend, view, target, depth_m, confidence, settings, .. } = self;
        let training = TrainingView {
            view: *view,
            target: TargetImage::RgbF32(target),
            depth: Some(DepthTarget { depth_m, confidence }),
            exposure_slot: Some(0),
        };
        let (_, texels) = backend.training_gradients(&training, settings, &mut params).expect("fits");
        let texels = texels.to_vec();
        (params, texels)
    }

    /// Loss with one trained number of every Gaussian in turn moved by `step`.
    fn moved(&mut self, params: &[GaussianParams], gaussian: usize, number: usize, step: f32) -> f64 {
        let mut params = params.to_vec();
        let mut numbers = <[f32; N_PARAMS]>::read_from_bytes(params[gaussian].as_bytes()).expect("14 numbers");
        numbers[number] += step;
        params[gaussian] = GaussianParams::read_from_bytes(numbers.as_bytes()).expect("14 numbers");
        let slots: Vec<u32> = (0..self.headers.len() as u32).collect();
        assert_eq!(self.backend.write_anchors(&slots, &self.headers, &params), 0);
        self.loss()
    }
}

/// `tolerance`: a splat ends where alpha is 1/255; differences see that border move, gradients do not. The exact checks
/// are those of the stages (`golden`, `lanes`, `loss`); this one is that nothing is missing between them.
fn check_params(what: &str, tolerance: f64, weights: LossWeights) {
    const STEP: f32 = 4e-3;
    let mut problem = Problem::new(weights);
    problem.backend.write_exposure(0, EXPOSURE);
    let params = read(&problem.backend);
    let (gradients, _) = problem.gradients();
    let mut differences = Vec::new();
    for gaussian in 0..params.len() {
        for number in 0..N_PARAMS {
            let (up, down) =
                (problem.moved(&params, gaussian, number, STEP), problem.moved(&params, gaussian, number, -STEP));
            differences.push(((up - down) / f64::from(2.0 * STEP)) as f32);
        }
    }
    let result = compare_gradients(gradients.as_flattened(), &differences, tolerance);
    println!("{what}: {result:?}");
    assert!(result.is_ok(), "{what}: {result:?}");
    let flipped: Vec<f32> = differences.iter().map(|d| -d).collect();
    assert!(
        compare_gradients(gradients.as_flattened(), &flipped, tolerance).is_err(),
        "{what}: a flipped sign must fail"
    );
}

#[test]
fn gradients_of_every_loss_term_agree_with_differences() {
    check_params("l1", 0.04, LossWeights { l1: 0.8, ..NONE });
    check_params("ssim", 0.15, LossWeights { ssim: 0.2, ..NONE });
    check_params("depth", 0.08, LossWeights { depth: 0.01, ..NONE });
}

#[test]
fn the_reported_loss_is_that_of_the_equations() {
    let mut problem = Problem::new(LossWeights { isotropy: 0.0, ..LossWeights::METHOD });
    problem.backend.write_exposure(0, EXPOSURE);
    let (reported, expected) = (problem.reported_loss(), problem.loss());
    let exposure = problem.settings.weights.exposure * reported.exposure;
    assert!((f64::from(reported.total - exposure) - expected).abs() < 1e-5, "{reported:?}, expected {expected}");
    assert!(reported.isotropy > 0.1, "{reported:?}");
}

#[test]
fn gradients_of_the_background_agree_with_differences() {
    const STEP: f32 = 0.05;
    let mut problem = Problem::new(LossWeights { l1: 0.8, ssim: 0.2, ..NONE });
    let (_, gradients) = problem.gradients();
    let mut seen: Vec<usize> = (0..BACKGROUND_TEXELS).filter(|&i| gradients[i][1].abs() > 1e-4).collect();
    assert!(seen.len() > 100, "the scene shows {} texels", seen.len());
    seen.truncate(40);
    let mut texels = vec![[0.0; 3]; BACKGROUND_TEXELS];
    assert!(problem.backend.read_background(0, &mut texels));
    let mut moved = |at: usize, step: f32| {
        let mut changed = texels.clone();
        changed[at][1] += step;
        assert!(problem.backend.write_background(0, &changed));
        problem.loss()
    };
    let differences: Vec<f32> =
        seen.iter().map(|&i| ((moved(i, STEP) - moved(i, -STEP)) / f64::from(2.0 * STEP)) as f32).collect();
    let gradients: Vec<f32> = seen.iter().map(|&i| gradients[i][1]).collect();
    let result = compare_gradients(&gradients, &differences, 0.01);
    assert!(result.is_ok(), "{result:?}");
}
