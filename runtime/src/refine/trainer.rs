//! Trains the map part by part.

use super::images::StoredImages;
use super::renew::{RenewCounts, Renewal};
use super::schedule::{self, Part};
use super::settings::LifecycleSettings;
use super::stretch::StretchMemory;
use crate::fit::{self, Clock, TrainingImages};
use crate::map_store::{MapStoreReader, StoreError};
use crate::mapping::PruneLimits;
use crate::render_views::map_from_camera;
use crate::splat::{Exposure, StepSettings, TargetImage, TrainingView, View};
use kilogs_core::map::quota::RouteMeasure;
use kilogs_core::math::Rng;
use std::collections::BTreeSet;
use std::time::{Duration, Instant};

/// Purpose of the draws here (see [`Rng::new`]).
const VIEW_CHOICE: u64 = 0x7265_666e;

/// Loads, trains and stores one part after the other.
pub(super) struct Trainer<'a> {
    pub(super) map: &'a MapStoreReader,
    pub(super) memory: StretchMemory<'a>,
    pub(super) images: TrainingImages<StoredImages<'a>>,
    pub(super) step: StepSettings,
    pub(super) lifecycle: LifecycleSettings,
    pub(super) limits: PruneLimits,
    pub(super) measure: RouteMeasure,
    /// Resolution of the first steps, and of the views that scores come from.
    pub(super) coarse_resolution: f64,
    pub(super) learned_exposure: bool,
    pub(super) clock: Clock,
    pub(super) seed: u64,
    pub(super) counts: TrainingCounts,
    /// Keyframes whose picture cannot be read.
    pub(super) blind: BTreeSet<usize>,
    /// Called every few steps with the progress in [0, 1]; false ends the training.
    pub(super) on_progress: &'a mut dyn FnMut(f64) -> bool,
}

/// What was done.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TrainingCounts {
    /// Optimizer steps taken.
    pub steps: u64,
    /// Steps that the backend refused.
    pub refused: u64,
    /// Time that they took.
    pub training: Duration,
    /// Parts of the route that were stored; each place belongs to two.
    pub parts: u64,
    /// What came and went.
    pub renewed: RenewCounts,
}

impl Trainer<'_> {
    /// Passes along the route.
    ///
    /// # Errors
    /// [`StoreError`] when something cannot be stored.
    pub(super) fn run(&mut self, parts: &[Part]) -> Result<(), StoreError> {
        for (part, nth) in parts.iter().zip(0..) {
            if self.spent() >= part.effort.end {
                continue;
            }
            let views = self.memory.load(part.keyframes.clone());
            let goes_on = self.train_part(part, &views, nth);
            self.memory.store_and_clear()?;
            self.counts.parts += 1;
            if !goes_on {
                break;
            }
        }
        Ok(())
    }

    fn spent(&self) -> f64 {
        self.clock.progress(self.counts.steps + self.counts.refused)
    }

    /// Trains on `views`, the part's own first, until its share of the effort is spent; false when all training is to end.
    fn train_part(&mut self, part: &Part, views: &[usize], nth: u64) -> bool {
        let n_slots = self.begin_exposures(views.len());
        let mut order: Vec<TrainedView> =
            views.iter().zip(0..n_slots).map(|(&idx, slot)| TrainedView { idx, slot }).collect();
        order.retain(|view| self.is_seen(view.idx));
        let mut rng = Rng::new(self.seed, nth, VIEW_CHOICE);
        let mut psnr = MeanPsnr::default();
        let mut is_renewed = false;
        while !order.is_empty() && self.spent() < part.effort.end {
            fit::shuffle(&mut order, &mut rng);
            psnr = MeanPsnr::default();
            for &view in &order {
                let spent = self.spent();
                if spent >= part.effort.end {
                    break;
                }
                if !is_renewed && spent >= part.renews_at() {
                    self.renew(part);
                    is_renewed = true;
                }
                psnr.add(self.train_on(view, part, spent));
                if !(self.on_progress)(spent) {
                    return false;
                }
            }
            order.retain(|view| !self.blind.contains(&view.idx));
        }
        log::info!(
            "{:.0} %: keyframes {} to {} at {:.2} dB while they were trained",
            100.0 * self.spent().min(1.0),
            part.keyframes.start,
            part.keyframes.end,
            psnr.mean_db()
        );
        true
    }

    /// Whether a keyframe can be trained on: one of a street that was driven before has no picture.
    fn is_seen(&self, view_idx: usize) -> bool {
        let has_picture = self.map.keyframes().get(view_idx).is_some_and(|keyframe| keyframe.image_bytes > 0);
        has_picture && !self.blind.contains(&view_idx)
    }

    /// Each of so many pictures counts as exposed like the map until steps say otherwise; how many can be trained.
    fn begin_exposures(&mut self, n_views: usize) -> u32 {
        let n_slots = n_views.min(self.memory.backend().capacities().exposure_slots) as u32;
        for slot in 0..n_slots {
            self.memory.backend().write_exposure(slot, Exposure::IDENTITY);
        }
        if self.learned_exposure { n_slots } else { n_views as u32 }
    }

    /// Scores a part's anchors over a uniform subset of its views, ends some and splits others.
    fn renew(&mut self, part: &Part) {
        let own = &self.map.keyframes()[part.keyframes.clone()];
        let (Some(first), Some(last)) = (own.first(), own.last()) else { return };
        let keyframe_ids = first.keyframe_id..=last.keyframe_id;
        let length_m = self.memory.own_length_m(&keyframe_ids, &self.measure);
        let most_gaussians = (self.lifecycle.max_gaussians_per_m * length_m).ceil() as u64;
        let mut renewal = Renewal::new(&mut self.memory);
        let n_views = self.lifecycle.views.min(own.len());
        for nth in 0..n_views {
            let slot = (2 * nth + 1) * own.len() / (2 * n_views);
            let view = TrainedView { idx: part.keyframes.start + slot, slot: slot as u32 };
            let lifecycle = self.lifecycle;
            self.look_at(view, self.coarse_resolution, |memory, view, _| {
                let report = renewal.score(memory, view, &lifecycle);
                (report.stats.refused, report.loss.mse)
            });
        }
        self.counts.renewed +=
            renewal.apply(&mut self.memory, (keyframe_ids, most_gaussians), (&self.lifecycle, &self.limits));
    }

    /// Takes one step; PSNR before it, `None` when it was not taken.
    fn train_on(&mut self, view: TrainedView, part: &Part, spent: f64) -> Option<f32> {
        let progress = part.progress_at(spent);
        let resolution = schedule::resolution(progress, self.coarse_resolution);
        let step = schedule::step(&self.step, progress);
        let started = Instant::now();
        let (is_refused, mse) = self.look_at(view, resolution, |memory, view, chunk_row| {
            let report = memory.backend().train_step(view, &StepSettings { decoder_row: Some(chunk_row), ..step });
            (report.stats.refused, report.loss.mse)
        })?;
        self.counts.training += started.elapsed();
        if is_refused {
            self.counts.refused += 1;
            return None;
        }
        self.counts.steps += 1;
        Some(-10.0 * mse.max(1e-10).log10())
    }

    /// Hands a view with its picture and the row of its chunk to `look`; `None` when they cannot be had.
    fn look_at<T>(
        &mut self,
        TrainedView { idx: view_idx, slot }: TrainedView,
        resolution: f64,
        look: impl FnOnce(&mut StretchMemory<'_>, &TrainingView<'_>, u16) -> T,
    ) -> Option<T> {
        let keyframe = self.map.keyframes().get(view_idx).filter(|_| self.is_seen(view_idx))?;
        let channels = self.images.channels();
        let image = self.images.at(view_idx, resolution);
        let (Ok((camera, pixels)), Some(chunk_row)) = (image, self.memory.chunk_row(keyframe.chunk_id)) else {
            log::warn!("frame {} is not trained on: its picture or its chunk cannot be had", keyframe.frame_index);
            self.blind.insert(view_idx);
            return None;
        };
        let target = if channels == 1 { TargetImage::Gray8(pixels) } else { TargetImage::Rgb8(pixels) };
        let view = View { camera_from_map: map_from_camera(keyframe).inverse(), camera, chunk_row };
        let exposure_slot = self.learned_exposure.then_some(slot);
        let training = TrainingView { view, target, depth: None, exposure_slot };
        Some(look(&mut self.memory, &training, chunk_row))
    }
}

/// A view of a part.
#[derive(Debug, Clone, Copy)]
struct TrainedView {
    /// Its keyframe, by its place in the map's list.
    idx: usize,
    /// Slot of its exposure.
    slot: u32,
}

/// Mean of what was measured.
#[derive(Default)]
struct MeanPsnr {
    sum_db: f32,
    n: u32,
}

impl MeanPsnr {
    fn add(&mut self, psnr_db: Option<f32>) {
        if let Some(psnr_db) = psnr_db {
            self.sum_db += psnr_db;
            self.n += 1;
        }
    }

    fn mean_db(&self) -> f32 {
        self.sum_db / self.n.max(1) as f32
    }
}
