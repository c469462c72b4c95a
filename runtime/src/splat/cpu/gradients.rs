//! Gradients without a step, for tests and for the conformance of other backends.

use super::backend::CpuBackend;
use super::decode::N_PARAMS;
use super::decoders::DecoderRule;
use super::learn::{Collected, LearnRule};
use super::update::UpdateRule;
use crate::splat::{AnchorFeature, ChunkRows, StepReport, StepSettings, TrainingView, View};
use kilogs_core::map::decoder::NO_FEATURE;

impl CpuBackend {
    /// Loss of a training view and its gradients with respect to every Gaussian's trained numbers (`slot * k + i`; 0
    /// where nothing is visible) and to the background's texels. For tests and for the conformance of other backends;
    /// trains nothing. `None` when a length or the view does not fit.
    pub fn training_gradients(
        &mut self,
        training: &TrainingView<'_>,
        settings: &StepSettings,
        params: &mut [[f32; N_PARAMS]],
    ) -> Option<(StepReport, &[[f32; 3]])> {
        if !self.capacities.fits_training(training) || params.len() != self.anchors.params.len() {
            return None;
        }
        params.fill([0.0; N_PARAMS]);
        let report = self.pass(training, settings, Collected { params: Some(params), features: None }).report;
        Some((report, self.sky.last_gradients()))
    }

    /// Gradients like those of [`training_gradients`](Self::training_gradients), and those with respect to the features
    /// of every slot and to the decoder of the step's decoder row (in the layout of
    /// [`kilogs_core::map::decoder`]). `None` without a learned decoder, too.
    pub fn decoder_gradients(
        &mut self,
        training: &TrainingView<'_>,
        settings: &StepSettings,
        params: &mut [[f32; N_PARAMS]],
        features: &mut [AnchorFeature],
    ) -> Option<(StepReport, &[f32])> {
        let lengths = params.len() == self.anchors.params.len() && features.len() == self.capacities.anchors;
        if !self.capacities.fits_training(training) || !lengths || !self.capacities.learned_decoder {
            return None;
        }
        params.fill([0.0; N_PARAMS]);
        features.fill(NO_FEATURE);
        let collected = Collected { params: Some(params), features: Some(features) };
        let report = self.pass(training, settings, collected).report;
        Some((report, self.decoder_grads.total()))
    }

    /// Gradients of `sum(rgb * upstream_rgb) + sum(depth * upstream_depth) + sum(transmittance *
    /// upstream_transmittance)` with respect to every Gaussian's trained numbers (`slot * k + i`; 0 where nothing is
    /// visible) and to the background's texels. For tests and for the conformance of other backends; trains nothing.
    ///
    /// The planes are red, green, blue, depth, transmittance. `None` when a length or the view does not fit.
    pub fn gradients(
        &mut self,
        view: &View,
        upstream: [&[f32]; 5],
        params: &mut [[f32; N_PARAMS]],
    ) -> Option<&[[f32; 3]]> {
        let n_pixels = view.n_pixels();
        let fits = self.capacities.fits(view) && n_pixels <= self.capacities.training_pixels;
        if !fits || upstream.iter().any(|p| p.len() != n_pixels) || params.len() != self.anchors.params.len() {
            return None;
        }
        let drawn = self.draw(view);
        self.loss.set_gradients(upstream);
        params.fill([0.0; N_PARAMS]);
        let update = UpdateRule {
            rates: [0.0; N_PARAMS],
            isotropy_weight: 0.0,
            pose_gradient: false,
            finished: ChunkRows::NONE,
        };
        let rule = LearnRule { update, decoder: DecoderRule::FROZEN };
        self.learn(&drawn, &rule, Collected { params: Some(params), features: None });
        Some(self.sky.last_gradients())
    }
}
