//! The loss of a picture and its gradient with respect to what was drawn.

use super::simd::Dispatch;
use super::splats::take_front;
use super::ssim::{Channel, SSIM_PLANES, add_ssim};
use crate::pool::Pool;
use crate::splat::kernel_constants::BYTE_SCALE;
use crate::splat::{Capacities, DepthTarget, Exposure, LossTerms, LossWeights, TargetImage};

/// Planes of the loss, each as large as the picture.
pub struct LossBuffers {
    /// Red, green, blue to imitate.
    target: Vec<f32>,
    /// Red, green, blue after exposure.
    exposed: Vec<f32>,
    /// Gradients with respect to red, green, blue, depth and transmittance.
    grad: Vec<f32>,
    scratch: Vec<f32>,
}

/// Bytes per pixel of training.
pub const TRAINING_PIXEL_BYTES: usize = (3 + 3 + N_DRAWN + SSIM_PLANES) * size_of::<f32>();

/// Red, green, blue, depth, transmittance.
pub const N_DRAWN: usize = 5;

/// Most jobs; fixed, so that sums do not depend on the thread count.
const MAX_BANDS: usize = 32;

/// What the picture loss found out about exposure.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ExposureGradient {
    /// With respect to the gains.
    pub gain: [f64; 3],
    /// With respect to the biases.
    pub bias: [f64; 3],
}

/// What to compare with.
#[derive(Clone, Copy)]
pub struct LossInput<'a> {
    /// Width, px.
    pub width: usize,
    /// Color to imitate.
    pub target: TargetImage<'a>,
    /// Depth to imitate.
    pub depth: Option<DepthTarget<'a>>,
    /// Brightness of the view, `None` to compare as is.
    pub exposure: Option<Exposure>,
    /// Factors of the terms.
    pub weights: LossWeights,
}

impl LossBuffers {
    /// Buffers for the largest training picture.
    pub fn new(capacities: &Capacities) -> Self {
        let n = capacities.training_pixels;
        Self {
            target: vec![0.0; 3 * n],
            exposed: vec![0.0; 3 * n],
            grad: vec![0.0; N_DRAWN * n],
            scratch: vec![0.0; SSIM_PLANES * n],
        }
    }

    /// Gradients with respect to the five planes drawn, of `n_pixels` each.
    pub fn gradients(&self, n_pixels: usize) -> [&[f32]; N_DRAWN] {
        core::array::from_fn(|i| &self.grad[i * n_pixels..(i + 1) * n_pixels])
    }

    /// Overwrites the gradients.
    pub fn set_gradients(&mut self, planes: [&[f32]; N_DRAWN]) {
        for (to, from) in self.grad.chunks_exact_mut(planes[0].len()).zip(planes) {
            to.copy_from_slice(from);
        }
    }

    /// Marks with 1 every pixel whose color, after exposure, is off by more than `threshold` in the mean over the
    /// channels, others with 0; returns how many are marked. Compares what [`evaluate`](Self::evaluate) compared last.
    pub fn mark_errors(&mut self, n_pixels: usize, threshold: f32) -> u32 {
        let n = n_pixels;
        let mut n_marked = 0;
        for (i, mark) in self.scratch[..n].iter_mut().enumerate() {
            let [r, g, b] = [i, n + i, 2 * n + i].map(|at| (self.exposed[at] - self.target[at]).abs());
            let is_wrong = r + g + b > 3.0 * threshold;
            *mark = f32::from(u8::from(is_wrong));
            n_marked += u32::from(is_wrong);
        }
        n_marked
    }

    /// What [`mark_errors`](Self::mark_errors) marked.
    pub fn error_marks(&self, n_pixels: usize) -> &[f32] {
        &self.scratch[..n_pixels]
    }

    /// Computes the loss (without isotropy and the exposure's own term) and the gradients.
    pub fn evaluate(
        &mut self,
        pool: &Pool,
        dispatch: Dispatch,
        input: &LossInput<'_>,
        drawn: [&[f32]; N_DRAWN],
    ) -> (LossTerms, ExposureGradient) {
        let n = drawn[0].len();
        let sums = self.compare_pixels(pool, input, drawn);
        let n_values = (3 * n) as f64;
        let mut ssim_sum = 0.0;
        if input.weights.ssim != 0.0 {
            let weight = -input.weights.ssim / n_values as f32;
            for i in 0..3 {
                let plane = i * n..(i + 1) * n;
                let channel =
                    Channel { width: input.width, x: &self.exposed[plane.clone()], y: &self.target[plane.clone()] };
                ssim_sum += add_ssim(pool, dispatch, channel, weight, &mut self.scratch, &mut self.grad[plane]);
            }
        }
        let exposure_gradient = self.through_exposure(n, input.exposure, drawn);
        let mut terms = LossTerms {
            l1: (sums.absolute / n_values) as f32,
            mse: (sums.square / n_values) as f32,
            ssim: (ssim_sum / n_values) as f32,
            ..LossTerms::default()
        };
        if sums.confidence > 0.0 {
            terms.depth = (sums.depth / sums.confidence) as f32;
        }
        terms.total = input.weights.l1 * terms.l1 + input.weights.depth * terms.depth;
        if input.weights.ssim != 0.0 {
            terms.total += input.weights.ssim * (1.0 - terms.ssim);
        }
        (terms, exposure_gradient)
    }

    /// Unpacks the target, applies the exposure, and starts the gradients with the terms that look at one pixel.
    fn compare_pixels(&mut self, pool: &Pool, input: &LossInput<'_>, drawn: [&[f32]; N_DRAWN]) -> PixelSums {
        let n = drawn[0].len();
        let confidence: f64 =
            input.depth.map_or(0.0, |depth| depth.confidence.iter().map(|&c| f64::from(c.max(0.0))).sum());
        let scales = PixelScales {
            color: input.weights.l1 / (3 * n) as f32,
            depth: if confidence > 0.0 { input.weights.depth / confidence as f32 } else { 0.0 },
        };
        let band_len = n.div_ceil(MAX_BANDS);
        let mut target = PlaneCutter::<3>::new(&mut self.target, n);
        let mut exposed = PlaneCutter::<3>::new(&mut self.exposed, n);
        let mut grad = PlaneCutter::<N_DRAWN>::new(&mut self.grad, n);
        let mut jobs = heapless::Vec::<PixelJob<'_>, MAX_BANDS>::new();
        for first in (0..n).step_by(band_len) {
            let len = band_len.min(n - first);
            let job = PixelJob {
                first,
                target: target.cut(len),
                exposed: exposed.cut(len),
                grad: grad.cut(len),
                sums: PixelSums::default(),
            };
            if jobs.push(job).is_err() {
                unreachable!("pixels are divided by MAX_BANDS");
            }
        }
        pool.for_each(&mut jobs, |_, job| job.run(input, drawn, scales));
        let mut sums = PixelSums { confidence, ..PixelSums::default() };
        for job in &jobs {
            sums.absolute += job.sums.absolute;
            sums.square += job.sums.square;
            sums.depth += job.sums.depth;
        }
        sums
    }

    /// Gradients of the exposure, and those of the color carried through it.
    fn through_exposure(&mut self, n: usize, exposure: Option<Exposure>, drawn: [&[f32]; N_DRAWN]) -> ExposureGradient {
        let mut out = ExposureGradient::default();
        let Some(exposure) = exposure else { return out };
        for (channel, drawn) in drawn.iter().take(3).enumerate() {
            for (grad, &value) in self.grad[channel * n..(channel + 1) * n].iter_mut().zip(*drawn) {
                out.gain[channel] += f64::from(*grad * value);
                out.bias[channel] += f64::from(*grad);
                *grad *= exposure.gain[channel];
            }
        }
        out
    }
}

/// Planes stored one after the other, cut from the front in step.
struct PlaneCutter<'a, const N: usize> {
    planes: [&'a mut [f32]; N],
}

impl<'a, const N: usize> PlaneCutter<'a, N> {
    fn new(mut planes: &'a mut [f32], n: usize) -> Self {
        Self { planes: core::array::from_fn(|_| take_front(&mut planes, n)) }
    }

    fn cut(&mut self, len: usize) -> [&'a mut [f32]; N] {
        core::array::from_fn(|i| take_front(&mut self.planes[i], len))
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct PixelSums {
    absolute: f64,
    square: f64,
    depth: f64,
    confidence: f64,
}

/// Loss gradient per unit of difference.
#[derive(Clone, Copy)]
struct PixelScales {
    color: f32,
    depth: f32,
}

struct PixelJob<'a> {
    first: usize,
    target: [&'a mut [f32]; 3],
    exposed: [&'a mut [f32]; 3],
    grad: [&'a mut [f32]; N_DRAWN],
    sums: PixelSums,
}

impl PixelJob<'_> {
    fn run(&mut self, input: &LossInput<'_>, drawn: [&[f32]; N_DRAWN], scales: PixelScales) {
        self.unpack(input.target);
        let range = self.first..self.first + self.target[0].len();
        let exposure = input.exposure.unwrap_or(Exposure::IDENTITY);
        for (channel, drawn) in drawn.iter().take(3).enumerate() {
            let (gain, bias) = (exposure.gain[channel], exposure.bias[channel]);
            let outputs = self.exposed[channel].iter_mut().zip(self.grad[channel].iter_mut());
            let (mut absolute, mut square) = (0.0, 0.0);
            for ((&value, &target), (exposed, grad)) in
                drawn[range.clone()].iter().zip(&*self.target[channel]).zip(outputs)
            {
                *exposed = gain * value + bias;
                let difference = *exposed - target;
                *grad = scales.color * sign(difference);
                absolute += f64::from(difference.abs());
                square += f64::from(difference * difference);
            }
            self.sums.absolute += absolute;
            self.sums.square += square;
        }
        let [_, _, _, grad_depth, grad_transmittance] = &mut self.grad;
        grad_depth.fill(0.0);
        grad_transmittance.fill(0.0);
        let Some(depth) = input.depth else { return };
        let targets = depth.depth_m[range.clone()].iter().zip(&depth.confidence[range.clone()]);
        for ((&value, (&target, &confidence)), grad) in drawn[3][range].iter().zip(targets).zip(grad_depth.iter_mut()) {
            if confidence > 0.0 {
                *grad = scales.depth * confidence * sign(value - target);
                self.sums.depth += f64::from(confidence * (value - target).abs());
            }
        }
    }

    fn unpack(&mut self, target: TargetImage<'_>) {
        let range = self.first..self.first + self.target[0].len();
        let [red, green, blue] = &mut self.target;
        let planes = red.iter_mut().zip(green.iter_mut()).zip(blue.iter_mut());
        match target {
            TargetImage::Rgb8(bytes) => {
                for (((red, green), blue), rgb) in planes.zip(bytes[3 * range.start..].chunks_exact(3)) {
                    (*red, *green, *blue) = (unit(rgb[0]), unit(rgb[1]), unit(rgb[2]));
                }
            }
            TargetImage::Gray8(bytes) => {
                for (((red, green), blue), &gray) in planes.zip(&bytes[range]) {
                    let value = unit(gray);
                    (*red, *green, *blue) = (value, value, value);
                }
            }
            TargetImage::RgbF32(pixels) => {
                for (((red, green), blue), rgb) in planes.zip(&pixels[range]) {
                    (*red, *green, *blue) = (rgb[0], rgb[1], rgb[2]);
                }
            }
        }
    }
}

fn unit(byte: u8) -> f32 {
    f32::from(byte) * BYTE_SCALE
}

/// -1, 0 or 1.
fn sign(value: f32) -> f32 {
    f32::from(i8::from(value > 0.0) - i8::from(value < 0.0))
}
