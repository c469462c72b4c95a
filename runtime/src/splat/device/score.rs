//! Scores of a view on a device (see `SplatBackend::score_view`).

use super::backend::DeviceBackend;
use super::executor::Executor;
use super::training::{loss_terms, upload_target};
use crate::splat::kernel_constants::{SCORE_WORDS, SUM_ANISOTROPY};
use crate::splat::layout::{Counters, ViewBlock};
use crate::splat::program::{Buffer, Part};
use crate::splat::{AnchorScore, LossWeights, ScoreReport, StepSettings, TrainingView};
use zerocopy::IntoBytes;

const _: () =
    assert!(size_of::<AnchorScore>() == SCORE_WORDS as usize * size_of::<u32>(), "scores are read as they lie");

impl<E: Executor> DeviceBackend<E> {
    /// Draws, compares and scores; refused when something does not fit or the device fails.
    pub(super) fn score(
        &mut self,
        training: &TrainingView<'_>,
        error_threshold: f32,
        scores: &mut [AnchorScore],
    ) -> ScoreReport {
        let training = TrainingView { depth: None, ..*training };
        if !self.capacities.fits_training(&training) || scores.len() != self.capacities.anchors {
            return ScoreReport::refused();
        }
        let settings = StepSettings { weights: LossWeights::PHOTOMETRIC, ..StepSettings::direct(0.0).frozen() };
        let block = ViewBlock { error_threshold, ..self.training_block(&training, &settings) };
        let prepared = self.device.call(|e| {
            upload_target(e, training.target)?;
            e.clear(Buffer::AnchorScores, 0, size_of_val(scores))
        });
        let parts = self.drawing_then(&[Part::Compare, Part::Score]);
        if !prepared || !self.run(&training.view, &block, &parts) {
            return ScoreReport::refused();
        }
        self.read_scores(&block, scores).unwrap_or_else(ScoreReport::refused)
    }

    fn read_scores(&self, block: &ViewBlock, scores: &mut [AnchorScore]) -> Option<ScoreReport> {
        let stats = self.stats()?;
        let mut found = self.loss_report()?;
        // Nothing was found out about anisotropies: these are those of another view.
        found.sums[SUM_ANISOTROPY as usize] = 0.0;
        let mut counters = Counters::default();
        let read = self.device.call(|e| {
            e.download(Buffer::Counters, 0, counters.as_mut_bytes())?;
            e.download(Buffer::AnchorScores, 0, scores.as_mut_bytes())
        });
        let loss = loss_terms(&found, block, &stats);
        read.then_some(ScoreReport { loss, masked_pixels: counters.masked_pixels, stats })
    }
}
