//! Training steps: which keyframe is looked at next.

use super::mapper::Mapper;
use crate::splat::{StepSettings, TargetImage, TrainingView, View};
use kilogs_core::math::Rng;

/// What the steps achieved.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OptimizeReport {
    /// Steps that were taken.
    pub n_iterations: u32,
    /// Steps that the backend refused.
    pub n_refused: u32,
    /// PSNR of the views before their steps, mean over the steps at mapping resolution, dB.
    pub mean_psnr_db: f32,
    /// Most Gaussians in view in one step.
    pub visible_peak: u32,
    /// Most entries of the lists of tile rows in one step.
    pub row_entries_peak: u32,
    /// Most Gaussian-tile pairs in one step.
    pub pairs_peak: u32,
    /// Gaussian-tile pairs that did not fit, summed over the steps.
    pub pairs_refused: u64,
}

/// Purpose of the draws here (see [`Rng::new`]).
const VIEW_CHOICE: u64 = 0x7669_6577;

impl Mapper {
    pub(super) fn run_optimizer(&mut self, n_iterations: u32) -> OptimizeReport {
        let mut report = OptimizeReport::default();
        if self.images.len() == 0 {
            return report;
        }
        let mut rng = Rng::new(self.settings.seed, self.counters.iterations, VIEW_CHOICE);
        let older = self.choose_older(&mut rng);
        let window = self.settings.window.min(self.images.len());
        let settings = StepSettings { decoder_row: self.learning_row(), ..self.settings.step };
        let mut psnr_sum_db = 0.0;
        for _ in 0..n_iterations {
            let luck = rng.unit_f32();
            let age = if luck < self.settings.newest_share || window == 1 {
                0
            } else if luck < self.settings.newest_share + self.settings.older_share && !older.is_empty() {
                older[rng.below(older.len())]
            } else {
                1 + rng.below(window - 1)
            };
            let Some(kept) = self.images.newest(age) else { continue };
            let target = match self.images.channels() {
                1 => TargetImage::Gray8(kept.pixels),
                _ => TargetImage::Rgb8(kept.pixels),
            };
            let view = View {
                camera_from_map: kept.keyframe.world_from_camera.inverse(),
                camera: *self.images.camera(),
                chunk_row: self.chunk_row(kept.keyframe.ordinal),
            };
            let training_view = TrainingView { view, target, depth: None, exposure_slot: None };
            let step = self.backend.train_step(&training_view, &settings);
            if step.stats.refused {
                report.n_refused += 1;
                continue;
            }
            report.n_iterations += 1;
            report.visible_peak = report.visible_peak.max(step.stats.visible);
            report.row_entries_peak = report.row_entries_peak.max(step.stats.row_entries);
            report.pairs_peak = report.pairs_peak.max(step.stats.pairs);
            report.pairs_refused += u64::from(step.stats.overflow.pairs);
            psnr_sum_db += -10.0 * step.loss.mse.max(1e-10).log10();
        }
        report.mean_psnr_db = psnr_sum_db / report.n_iterations.max(1) as f32;
        self.counters.iterations += u64::from(report.n_iterations);
        report
    }

    /// Ages of keyframes before the window whose anchors are still resident.
    fn choose_older(&self, rng: &mut Rng) -> heapless::Vec<usize, 8> {
        let mut chosen = heapless::Vec::new();
        let first = self.settings.window;
        let n_resident = (first..self.images.len())
            .take_while(|&age| self.images.newest(age).is_some_and(|kept| self.groups.holds(kept.keyframe.ordinal)))
            .count();
        for _ in 0..self.settings.older_views.min(n_resident) {
            // Drawing one twice only shares its steps.
            let _ = chosen.push(first + rng.below(n_resident));
        }
        chosen
    }
}
