//! Training steps: which keyframe is looked at next.

use super::mapper::Mapper;
use super::settings::MapperSettings;
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
}

/// Purpose of the draws here (see [`Rng::new`]).
const VIEW_CHOICE: u64 = 0x7669_6577;

/// Most keyframes before the window that are trained beside it.
pub const MAX_OLDER_VIEWS: usize = 8;

/// Age of the keyframe that the next step looks at.
fn draw_age(settings: &MapperSettings, window: usize, older: &[usize], rng: &mut Rng) -> usize {
    let luck = rng.unit_f32();
    if luck < settings.newest_share {
        0
    } else if luck < settings.newest_share + settings.older_share && !older.is_empty() {
        older[rng.below(older.len())]
    } else if window > 1 {
        1 + rng.below(window - 1)
    } else {
        0
    }
}

impl Mapper {
    pub(super) fn run_optimizer(&mut self, n_iterations: u32) -> OptimizeReport {
        let mut report = OptimizeReport::default();
        if self.images.len() == 0 {
            return report;
        }
        let mut rng = Rng::new(self.settings.seed, self.n_draws, VIEW_CHOICE);
        self.n_draws += u64::from(n_iterations);
        let older = self.choose_older(&mut rng);
        let window = self.settings.window.min(self.images.len());
        let decoder_row = self.learning_row();
        let settings = StepSettings { decoder_row, finished: self.finished_chunks(), ..self.settings.step };
        let mut psnr_sum_db = 0.0;
        for _ in 0..n_iterations {
            let drawn = draw_age(&self.settings, window, &older, &mut rng);
            let Some(kept) = self.teaching_age(drawn, &older).and_then(|age| self.images.newest(age)) else { continue };
            let target = match self.images.channels() {
                1 => TargetImage::Gray8(kept.pixels),
                _ => TargetImage::Rgb8(kept.pixels),
            };
            let Some(chunk_row) = self.chunk_row(kept.keyframe.ordinal) else { continue };
            let camera_from_map = kept.keyframe.world_from_camera.inverse();
            let view = View { camera_from_map, camera: *self.images.camera(), chunk_row };
            let depth = self.depths.of(kept.keyframe.ordinal);
            let exposure_slot = self.exposure_slot(kept.place);
            let training_view = TrainingView { view, target, depth, exposure_slot };
            let step = self.backend.train_step(&training_view, &settings);
            self.list_load.add(&step.stats);
            if step.stats.refused {
                report.n_refused += 1;
                continue;
            }
            report.n_iterations += 1;
            psnr_sum_db += -10.0 * step.loss.mse.max(1e-10).log10();
        }
        self.share_decoder();
        report.mean_psnr_db = psnr_sum_db / report.n_iterations.max(1) as f32;
        self.counters.iterations += u64::from(report.n_iterations);
        report
    }

    /// The keyframe that a step looks at: the one that was drawn, or an older one of another street where that shows nothing new.
    fn teaching_age(&self, drawn: usize, older: &[usize]) -> Option<usize> {
        if !self.shows_nothing_new(drawn) {
            return Some(drawn);
        }
        older.iter().copied().find(|&age| !self.is_of_known_street(age))
    }

    /// Ages of keyframes before the window whose anchors are still resident.
    fn choose_older(&self, rng: &mut Rng) -> heapless::Vec<usize, MAX_OLDER_VIEWS> {
        let mut chosen = heapless::Vec::new();
        let first = self.settings.window;
        let n_resident = (first..self.images.len())
            .take_while(|&age| {
                self.images.newest(age).is_some_and(|kept| self.paging.directory.holds(kept.keyframe.ordinal))
            })
            .count();
        for _ in 0..self.settings.older_views.min(n_resident) {
            // Drawing one twice only shares its steps.
            let _ = chosen.push(first + rng.below(n_resident));
        }
        chosen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_of_keyframe_gets_its_share_of_the_steps() {
        let check = |window: usize, older: &[usize], expected: [f32; 3]| {
            let settings = MapperSettings { newest_share: 0.5, older_share: 0.2, ..MapperSettings::measured(3, 1.0) };
            let (mut rng, mut shares) = (Rng::new(3, 0, VIEW_CHOICE), [0.0; 3]);
            for _ in 0..4000 {
                let age = draw_age(&settings, window, older, &mut rng);
                shares[if age == 0 { 0 } else { 1 + usize::from(age >= window) }] += 1.0 / 4000.0;
            }
            assert!(shares.iter().zip(expected).all(|(got, want)| (got - want).abs() < 0.03), "{window}: {shares:?}");
        };
        check(6, &[7, 9], [0.5, 0.3, 0.2]);
        check(6, &[], [0.5, 0.5, 0.0]);
        check(1, &[1], [0.8, 0.0, 0.2]);
        check(1, &[], [1.0, 0.0, 0.0]);
    }
}
