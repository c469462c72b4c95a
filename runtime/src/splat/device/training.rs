//! A training step on a device: what is uploaded before it, and what is read after it.

use super::backend::DeviceBackend;
use super::error::DeviceError;
use super::executor::Executor;
use super::runs::{Parts, refused};
use crate::splat::cpu::decode::group;
use crate::splat::cpu::decoders::DecoderRule;
use crate::splat::cpu::loss::ExposureGradient;
use crate::splat::kernel_constants::{
    DECODER_PIECES, NO_ROW, SUM_ABSOLUTE, SUM_ANISOTROPY, SUM_BIAS, SUM_DEPTH, SUM_GAIN, SUM_POSE, SUM_SKY_TURN,
    SUM_SQUARE, SUM_SSIM, TARGET_GRAY8, TARGET_RGB_F32, TARGET_RGB8,
};
use crate::splat::layout::{LossReport, ViewBlock};
use crate::splat::program::{Buffer, Part};
use crate::splat::{
    DecoderShape, DepthTarget, Exposure, LossTerms, PoseGradient, RenderStats, StepReport, StepSettings, TargetImage,
    TrainingView, View,
};
use zerocopy::IntoBytes;

impl<E: Executor> DeviceBackend<E> {
    /// Draws, compares and steps; refused when something does not fit or the device fails.
    pub(super) fn train(&mut self, training: &TrainingView<'_>, settings: &StepSettings) -> StepReport {
        let row = usize::from(training.view.chunk_row);
        let background_rate = settings.rates.background.at(settings.progress);
        let step = self.background_steps.get(row).map_or(0, |steps| steps.saturating_add(1));
        let decoder = decoder_rule(settings);
        let taken = self.compare(training, settings, step, &parts_of_step(settings));
        let Some((mut report, gradient)) = taken else {
            return StepReport { stats: refused(), ..StepReport::default() };
        };
        if background_rate > 0.0 {
            self.background_steps[row] = step;
        }
        if let Some(steps) = decoder.row.and_then(|row| self.decoder_steps.get_mut(usize::from(row))) {
            *steps = steps.saturating_add(1);
        }
        if let Some(slot) = training.exposure_slot {
            let weight = settings.weights.exposure;
            let rate = settings.rates.exposure.at(settings.progress);
            report.loss.exposure = self.exposures.step(slot, &gradient, weight, rate);
            report.loss.total += weight * report.loss.exposure;
        }
        report
    }

    /// Draws and runs parts of a training step; `background_step` counts the background's steps, this one included. `None` when
    /// something does not fit or the device fails.
    pub(super) fn compare(
        &mut self,
        training: &TrainingView<'_>,
        settings: &StepSettings,
        background_step: u32,
        learn: &[Part],
    ) -> Option<(StepReport, ExposureGradient)> {
        if !self.capacities.fits_training(training) {
            return None;
        }
        let block = ViewBlock { background_step, ..self.training_block(training, settings) };
        let uploaded = self.device.call(|e| {
            upload_target(e, training.target)?;
            training.depth.map_or(Ok(()), |depth| upload_depth(e, depth))
        });
        if !uploaded || !self.run(&training.view, &block, &self.drawing_then(learn)) {
            return None;
        }
        let stats = self.stats()?;
        let found = self.loss_report()?;
        let loss = loss_terms(&found, &block, &stats);
        let pose_gradient =
            if settings.pose_gradient { Some(self.pose_gradient(&training.view, &found)?) } else { None };
        let exposure = exposure_gradient(&found, training.exposure_slot.is_some());
        Some((StepReport { loss, stats, pose_gradient }, exposure))
    }

    /// The sums of the view that was compared last.
    pub(super) fn loss_report(&self) -> Option<LossReport> {
        let mut found = LossReport::default();
        let read = self.device.call(|e| e.download(Buffer::LossReport, 0, found.as_mut_bytes()));
        read.then_some(found)
    }

    /// Adds up what the Gaussians, the sky and the decoders say about the camera.
    fn pose_gradient(&self, view: &View, found: &LossReport) -> Option<PoseGradient> {
        let sums = |first: u32| [0, 1, 2].map(|i| f64::from(found.sums[first as usize + i]));
        let mut shift = sums(SUM_POSE + 3);
        if self.capacities.learned_decoder {
            let mut pieces = [[0.0f32; 3]; DECODER_PIECES as usize];
            let decoder_len = DecoderShape::new(self.capacities.gaussians_per_anchor).len();
            let at = DECODER_PIECES as usize * decoder_len * size_of::<f32>();
            if !self.device.call(|e| e.download(Buffer::DecoderSums, at, pieces.as_mut_bytes())) {
                return None;
            }
            for piece in &pieces {
                shift = [0, 1, 2].map(|i| shift[i] + f64::from(piece[i]));
            }
        }
        let sky = view.camera_from_map.rotation * nalgebra::Vector3::from(sums(SUM_SKY_TURN));
        let turn = nalgebra::Vector3::from(sums(SUM_POSE)) - sky;
        Some([turn.x, turn.y, turn.z, shift[0], shift[1], shift[2]])
    }

    /// The uniform block of a training view.
    pub(super) fn training_block(&self, training: &TrainingView<'_>, settings: &StepSettings) -> ViewBlock {
        let exposure = training.exposure_slot.and_then(|slot| self.exposures.get(slot)).unwrap_or(Exposure::IDENTITY);
        let per_channel = |v: [f32; 3]| [v[0], v[1], v[2], 0.0];
        let confidences = training.depth.map_or(0.0, |depth| {
            depth.confidence.iter().map(|&confidence| f64::from(confidence.max(0.0))).sum::<f64>()
        });
        let (rates, weights) = (&settings.rates, &settings.weights);
        let rate = |rate: &crate::splat::LearningRate| rate.at(settings.progress);
        ViewBlock {
            target_kind: match training.target {
                TargetImage::Rgb8(_) => TARGET_RGB8,
                TargetImage::Gray8(_) => TARGET_GRAY8,
                TargetImage::RgbF32(_) => TARGET_RGB_F32,
            },
            has_depth: u32::from(confidences > 0.0),
            has_exposure: u32::from(training.exposure_slot.is_some()),
            gain: per_channel(exposure.gain),
            bias: per_channel(exposure.bias),
            l1_weight: weights.l1,
            ssim_weight: weights.ssim,
            depth_weight: weights.depth,
            isotropy_weight: weights.isotropy,
            confidence_sum: confidences as f32,
            offset_rate: rate(&rates.offset),
            log_scale_rate: rate(&rates.log_scale),
            rotation_rate: rate(&rates.rotation),
            opacity_rate: rate(&rates.opacity),
            color_rate: rate(&rates.color),
            background_rate: rate(&rates.background),
            finds_pose: u32::from(settings.pose_gradient),
            finished_rows: settings.finished.bits(),
            ..self.decoder_block(&decoder_rule(settings), self.block(&training.view))
        }
    }

    /// The block with what decoders and features learn by.
    fn decoder_block(&self, rule: &DecoderRule, block: ViewBlock) -> ViewBlock {
        let steps = rule.row.and_then(|row| self.decoder_steps.get(usize::from(row)));
        ViewBlock {
            decoder_row: rule.row.map_or(NO_ROW, u32::from),
            decoder_step: steps.map_or(0, |steps| steps.saturating_add(1)),
            feature_rate: rule.feature_rate,
            hidden_rate: rule.hidden_rate,
            output_offset_rate: rule.output_rates[group::OFFSET],
            output_log_scale_rate: rule.output_rates[group::LOG_SCALE],
            output_rotation_rate: rule.output_rates[group::ROTATION],
            output_opacity_rate: rule.output_rates[group::OPACITY],
            output_color_rate: rule.output_rates[group::COLOR],
            ..block
        }
    }
}

/// The parts of a training step that follow the picture; what does not learn is left out.
fn parts_of_step(settings: &StepSettings) -> Parts {
    let finds_pose = settings.pose_gradient;
    let decoder_is_frozen = decoder_rule(settings).is_frozen();
    [
        (Part::Compare, true),
        (Part::TurnSky, finds_pose),
        (Part::Backward, true),
        (Part::Step, !settings.rates.map_is_frozen(settings.progress)),
        (Part::StepDecoder, !decoder_is_frozen || finds_pose),
    ]
    .into_iter()
    .filter_map(|(part, is_run)| is_run.then_some(part))
    .collect()
}

fn decoder_rule(settings: &StepSettings) -> DecoderRule {
    DecoderRule::at(&settings.rates.decoder, settings.decoder_row, settings.progress)
}

pub(super) fn upload_target<E: Executor>(executor: &mut E, target: TargetImage<'_>) -> Result<(), DeviceError> {
    let bytes = match target {
        TargetImage::Rgb8(bytes) | TargetImage::Gray8(bytes) => bytes,
        TargetImage::RgbF32(pixels) => pixels.as_bytes(),
    };
    let (words, rest) = bytes.split_at(bytes.len() & !3);
    if !words.is_empty() {
        executor.upload(Buffer::TargetWords, 0, words)?;
    }
    if rest.is_empty() {
        return Ok(());
    }
    let mut last = [0; 4];
    last[..rest.len()].copy_from_slice(rest);
    executor.upload(Buffer::TargetWords, words.len(), &last)
}

fn upload_depth<E: Executor>(executor: &mut E, depth: DepthTarget<'_>) -> Result<(), DeviceError> {
    executor.upload(Buffer::TargetDepth, 0, depth.depth_m.as_bytes())?;
    executor.upload(Buffer::TargetDepth, size_of_val(depth.depth_m), depth.confidence.as_bytes())
}

pub(super) fn loss_terms(found: &LossReport, block: &ViewBlock, stats: &RenderStats) -> LossTerms {
    let n_values = f64::from(3 * block.width * block.height);
    let mean = |i: u32, n: f64| (f64::from(found.sums[i as usize]) / n) as f32;
    let mut terms = LossTerms {
        l1: mean(SUM_ABSOLUTE, n_values),
        mse: mean(SUM_SQUARE, n_values),
        ssim: mean(SUM_SSIM, n_values),
        isotropy: mean(SUM_ANISOTROPY, f64::from(stats.visible.max(1))),
        ..LossTerms::default()
    };
    if block.has_depth != 0 {
        terms.depth = mean(SUM_DEPTH, f64::from(block.confidence_sum));
    }
    terms.total =
        block.l1_weight * terms.l1 + block.depth_weight * terms.depth + block.isotropy_weight * terms.isotropy;
    if block.ssim_weight != 0.0 {
        terms.total += block.ssim_weight * (1.0 - terms.ssim);
    }
    terms
}

fn exposure_gradient(found: &LossReport, has_exposure: bool) -> ExposureGradient {
    if !has_exposure {
        return ExposureGradient::default();
    }
    let three = |first: u32| [0, 1, 2].map(|i| f64::from(found.sums[first as usize + i]));
    ExposureGradient { gain: three(SUM_GAIN), bias: three(SUM_BIAS) }
}
