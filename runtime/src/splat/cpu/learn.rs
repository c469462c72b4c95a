//! What the backend learns from a view: the passes back, and the steps of anchors and decoders.

use super::backend::CpuBackend;
use super::decode::{N_PARAMS, group};
use super::decode_anchors::SeenAnchors;
use super::decode_anchors_backward::ShownGradients;
use super::decoders::DecoderRule;
use super::draw::{Drawn, Machine, ViewBuffers};
use super::loss::{ExposureGradient, LossInput};
use super::pose::{PoseSum, SeenSky};
use super::splatting::CameraView;
use super::update::{UpdateRule, UpdateSums, UpdateTarget, update};
use crate::splat::{AnchorFeature, LearningRates, StepReport, StepSettings, TrainingView};

/// What one pass over a training view found.
pub(super) struct Pass {
    pub(super) report: StepReport,
    pub(super) exposure_gradient: ExposureGradient,
}

/// How everything steps that is not of the view itself.
pub(super) struct LearnRule {
    pub(super) update: UpdateRule,
    pub(super) decoder: DecoderRule,
}

/// Where gradients go instead of a step being taken.
#[derive(Default)]
pub(super) struct Collected<'a> {
    /// One element per Gaussian of every slot.
    pub(super) params: Option<&'a mut [[f32; N_PARAMS]]>,
    /// One element per slot.
    pub(super) features: Option<&'a mut [AnchorFeature]>,
}
impl CpuBackend {
    /// Backward pass and step.
    pub(super) fn learn(&mut self, drawn: &Drawn, rule: &LearnRule, collected: Collected<'_>) -> UpdateSums {
        let machine = Machine { pool: &self.pool, dispatch: self.dispatch };
        let n_pixels = drawn.grid.n_pixels();
        let upstream = self.loss.gradients(n_pixels);
        self.view.draw_backward(machine, drawn, upstream);
        let transmittance = self.view.drawn(n_pixels)[4];
        let grad_rgb = [upstream[0], upstream[1], upstream[2]];
        self.sky.gradients(&self.pool, self.dispatch, &drawn.rays, &drawn.grid, transmittance, grad_rgb);
        self.view.clock.finish("sky");
        let turn = if rule.update.pose_gradient { self.sky_turn(drawn) } else { [0.0; 3] };
        let machine = Machine { pool: &self.pool, dispatch: self.dispatch };
        let ViewBuffers { lists, keyframes, shown, .. } = &mut self.view;
        let view = CameraView { keyframes, camera: drawn.camera, grid: drawn.grid };
        let shown = self.decoders.is_learned().then_some(shown.as_mut_slice());
        let target = UpdateTarget { anchors: &mut self.anchors, shown, collected: collected.params };
        let mut sums = update(machine, view, drawn.n_candidates, &rule.update, target, lists);
        self.view.clock.finish("update");
        sums.pose.add([turn[0], turn[1], turn[2], 0.0, 0.0, 0.0]);
        sums.pose.add(self.learn_decoder(rule, collected.features).0);
        sums
    }

    /// Gradient of the `omega` of the camera's pose through the directions in which it sees the sky.
    fn sky_turn(&mut self, drawn: &Drawn) -> [f64; 3] {
        let n_pixels = drawn.grid.n_pixels();
        let [red, green, blue, ..] = self.loss.gradients(n_pixels);
        let sky = SeenSky {
            rays: &drawn.rays,
            grid: drawn.grid,
            texels: self.sky.row(drawn.view.chunk_row).unwrap_or_default(),
            transmittance: self.view.drawn(n_pixels)[4],
            grad_rgb: [red, green, blue],
        };
        let torque = sky.ray_torque(&self.pool, self.dispatch);
        self.view.clock.finish("sky_turn");
        (drawn.view.camera_from_map.rotation * -nalgebra::Vector3::from(torque)).into()
    }

    /// From the gradients that `update` left in the place of what was drawn to features, decoder and pose.
    fn learn_decoder(&mut self, rule: &LearnRule, collected: Option<&mut [AnchorFeature]>) -> PoseSum {
        let LearnRule { update: UpdateRule { pose_gradient, .. }, decoder: rule } = rule;
        let only_collects = collected.is_some();
        if !self.decoders.is_learned() || (rule.is_frozen() && !only_collects && !pose_gradient) {
            return PoseSum::default();
        }
        let machine = Machine { pool: &self.pool, dispatch: self.dispatch };
        let seen = SeenAnchors {
            fixed: self.anchors.fixed(),
            decoders: &self.decoders,
            keyframes: &self.view.keyframes,
            cameras_in_keyframe_m: &self.view.cameras_in_keyframe_m,
        };
        let visible = &self.view.lists.visible_bits[..self.anchors.slots_end];
        let grads = ShownGradients { visible, grads: &self.view.shown };
        let features = self.features.storage(collected);
        let pose = self.decoder_grads.find(machine, seen, rule, grads, features, *pose_gradient);
        if !only_collects {
            self.decoders.step(rule, self.decoder_grads.total());
        }
        self.view.clock.finish("decode_backward");
        pose
    }

    /// Everything of a training step but the steps of background and exposure.
    pub(super) fn pass(
        &mut self,
        training: &TrainingView<'_>,
        settings: &StepSettings,
        collected: Collected<'_>,
    ) -> Pass {
        let drawn = self.draw(&training.view);
        let input = LossInput {
            width: drawn.grid.width,
            target: training.target,
            depth: training.depth,
            exposure: training.exposure_slot.and_then(|slot| self.exposures.get(slot)),
            weights: settings.weights,
        };
        let planes = self.view.drawn(drawn.grid.n_pixels());
        let (mut loss, exposure_gradient) = self.loss.evaluate(&self.pool, self.dispatch, &input, planes);
        self.view.clock.finish("loss");
        let n_visible = drawn.n_splats.max(1) as f32;
        let rule = LearnRule {
            update: UpdateRule {
                rates: rates_per_number(&settings.rates, settings.progress),
                isotropy_weight: settings.weights.isotropy / n_visible,
                pose_gradient: settings.pose_gradient,
                finished: settings.finished,
            },
            decoder: DecoderRule::at(&settings.rates.decoder, settings.decoder_row, settings.progress),
        };
        let sums = self.learn(&drawn, &rule, collected);
        loss.isotropy = sums.anisotropy as f32 / n_visible;
        loss.total += settings.weights.isotropy * loss.isotropy;
        let pose_gradient = settings.pose_gradient.then_some(sums.pose.0);
        Pass { report: StepReport { loss, stats: drawn.stats, pose_gradient }, exposure_gradient }
    }
}

fn rates_per_number(rates: &LearningRates, progress: f32) -> [f32; N_PARAMS] {
    let mut out = [0.0; N_PARAMS];
    out[group::OFFSET..group::LOG_SCALE].fill(rates.offset.at(progress));
    out[group::LOG_SCALE..group::ROTATION].fill(rates.log_scale.at(progress));
    out[group::ROTATION..group::OPACITY].fill(rates.rotation.at(progress));
    out[group::OPACITY] = rates.opacity.at(progress);
    out[group::COLOR..].fill(rates.color.at(progress));
    out
}
