//! The loss of given planes and its gradient, against its equations in f64.

use super::reference::ssim;
use crate::pool::Pool;
use crate::splat::cpu::loss::{LossBuffers, LossInput, N_DRAWN};
use crate::splat::cpu::simd::{Dispatch, SimdLevel};
use crate::splat::*;

const WIDTH: usize = 23;
const HEIGHT: usize = 17;
const N: usize = WIDTH * HEIGHT;
const EXPOSURE: Exposure = Exposure { gain: [1.1, 0.9, 1.0], bias: [0.02, -0.03, 0.0] };

struct Case {
    drawn: [Vec<f32>; N_DRAWN],
    target: Vec<[f32; 3]>,
    depth_m: Vec<f32>,
    confidence: Vec<f32>,
    weights: LossWeights,
}

fn case(weights: LossWeights) -> Case {
    let wave = |i: usize, f: f32| 0.5 + 0.3 * (i as f32 * f).sin() + 0.15 * ((i / WIDTH) as f32 * 3.0 * f).cos();
    Case {
        drawn: core::array::from_fn(|p| (0..N).map(|i| wave(i, 0.21 + 0.1 * p as f32)).collect()),
        target: (0..N).map(|i| [wave(i, 0.23), wave(i + 3, 0.3), wave(i, 0.9)]).collect(),
        depth_m: (0..N).map(|i| wave(i, 0.77)).collect(),
        confidence: (0..N).map(|i| (i % 5) as f32 * 0.25 - 0.25).collect(),
        weights,
    }
}

impl Case {
    fn gradients(&self, level: SimdLevel) -> (LossTerms, Vec<f32>) {
        let capacities = Capacities::for_map(1, 1, WIDTH as u32, HEIGHT as u32);
        let mut buffers = LossBuffers::new(&capacities);
        let input = LossInput {
            width: WIDTH,
            target: TargetImage::RgbF32(&self.target),
            depth: Some(DepthTarget { depth_m: &self.depth_m, confidence: &self.confidence }),
            exposure: Some(EXPOSURE),
            weights: self.weights,
        };
        let pool = Pool::new(2, |_| ()).expect("threads");
        let dispatch = Dispatch::new(level).expect("level");
        let drawn = core::array::from_fn(|p| self.drawn[p].as_slice());
        let (terms, _) = buffers.evaluate(&pool, dispatch, &input, drawn);
        (terms, buffers.gradients(N).concat())
    }

    /// The loss by its equations, with one number of the planes moved.
    fn loss(&self, at: usize, step: f64) -> f64 {
        let value = |p: usize, i: usize| f64::from(self.drawn[p][i]) + if p * N + i == at { step } else { 0.0 };
        let mut loss = 0.0;
        for p in 0..3 {
            let (gain, bias) = (f64::from(EXPOSURE.gain[p]), f64::from(EXPOSURE.bias[p]));
            let x: Vec<f64> = (0..N).map(|i| gain * value(p, i) + bias).collect();
            let y: Vec<f64> = self.target.iter().map(|rgb| f64::from(rgb[p])).collect();
            let l1 = x.iter().zip(&y).map(|(x, y)| (x - y).abs()).sum::<f64>() / N as f64;
            let structure = 1.0 - ssim(&x, &y, WIDTH);
            loss += (f64::from(self.weights.l1) * l1 + f64::from(self.weights.ssim) * structure) / 3.0;
        }
        let confidence = |i: usize| f64::from(self.confidence[i]).max(0.0);
        let total: f64 = (0..N).map(confidence).sum();
        let depth = (0..N).map(|i| confidence(i) * (value(3, i) - f64::from(self.depth_m[i])).abs()).sum::<f64>();
        loss + f64::from(self.weights.depth) * depth / total
    }
}

fn check(weights: LossWeights, planes: core::ops::Range<usize>) {
    const STEP: f64 = 1e-5;
    let case = case(weights);
    for level in SimdLevel::ALL.into_iter().filter(|level| level.is_available()) {
        let (terms, gradients) = case.gradients(level);
        assert!((f64::from(terms.total) - case.loss(usize::MAX, 0.0)).abs() < 1e-5, "{level}: {terms:?}");
        let largest = gradients.iter().fold(0.0f32, |a, g| a.max(g.abs()));
        // Corners, borders and the middle of every plane.
        let pixels = [0, 1, WIDTH - 1, 6 * WIDTH, 8 * WIDTH + 11, 9 * WIDTH + 4, N - WIDTH, N - 1];
        for at in planes.clone().flat_map(|p| pixels.map(|i| p * N + i)) {
            let difference = (case.loss(at, STEP) - case.loss(at, -STEP)) / (2.0 * STEP);
            let error = (f64::from(gradients[at]) - difference).abs() / f64::from(largest);
            assert!(error < 1e-3, "{level}, number {at}: {} by differences {difference}", gradients[at]);
        }
    }
}

#[test]
fn every_term_agrees_with_differences() {
    let none = LossWeights { l1: 0.0, ssim: 0.0, depth: 0.0, isotropy: 0.0, exposure: 0.0 };
    check(LossWeights { l1: 0.8, ..none }, 0..3);
    check(LossWeights { ssim: 0.2, ..none }, 0..3);
    check(LossWeights { depth: 0.01, ..none }, 3..5);
    check(LossWeights::METHOD, 0..5);
}

#[test]
fn bytes_are_unpacked_to_the_same_target() {
    let bytes: Vec<u8> = (0..3 * N).map(|i| (i * 89 % 256) as u8).collect();
    let floats: Vec<[f32; 3]> = bytes.chunks(3).map(|c| [c[0], c[1], c[2]].map(|v| f32::from(v) / 255.0)).collect();
    let gray: Vec<[f32; 3]> = bytes[..N].iter().map(|&v| [f32::from(v) / 255.0; 3]).collect();
    let l1 = |target: TargetImage<'_>| {
        let capacities = Capacities::for_map(1, 1, WIDTH as u32, HEIGHT as u32);
        let input = LossInput { width: WIDTH, target, depth: None, exposure: None, weights: LossWeights::METHOD };
        let drawn = case(LossWeights::METHOD).drawn;
        let pool = Pool::new(1, |_| ()).expect("threads");
        let dispatch = Dispatch::new(SimdLevel::best()).expect("level");
        let mut buffers = LossBuffers::new(&capacities);
        buffers.evaluate(&pool, dispatch, &input, core::array::from_fn(|p| drawn[p].as_slice())).0.l1
    };
    assert!((l1(TargetImage::Rgb8(&bytes)) - l1(TargetImage::RgbF32(&floats))).abs() < 1e-6);
    assert!((l1(TargetImage::Gray8(&bytes[..N])) - l1(TargetImage::RgbF32(&gray))).abs() < 1e-6);
    assert!((l1(TargetImage::Gray8(&bytes[..N])) - l1(TargetImage::RgbF32(&floats))).abs() > 1e-3);
}
