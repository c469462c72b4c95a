//! The backend that needs nothing but a processor.

use super::anchors::{Anchors, slot_bytes};
use super::cull::KeyframeNumbers;
use super::decode_anchors_backward::{DecoderGradients, decoder_gradient_bytes};
use super::decoders::{Decoders, decoder_row_bytes};
use super::draw::{Drawn, Machine, Map, ViewBuffers};
use super::exposures::{EXPOSURE_BYTES, Exposures};
use super::features::{FEATURE_BYTES, Features};
use super::learn::Collected;
use super::loss::{LossBuffers, N_DRAWN, TRAINING_PIXEL_BYTES};
use super::simd::{Dispatch, SimdLevel};
use super::sky::{SKY_GRADIENT_BYTES, SKY_ROW_BYTES, Sky};
use super::splats::{Lists, PAIR_BYTES, ROW_ENTRY_BYTES, VISIBLE_BYTES};
use crate::pool::Pool;
use crate::splat::{
    AnchorFeature, AnchorHeader, AnchorScore, Capacities, CapacityError, Exposure, GaussianParams, KeyframePlacement,
    MemoryRow, RenderStats, RenderTarget, ScoreReport, SplatBackend, StageClock, StageTimes, StepReport, StepSettings,
    TrainingView, View,
};
use kilogs_core::map::decoder::NO_FEATURE;
use zerocopy::FromZeros;

/// Splatting on the processor.
pub struct CpuBackend {
    pub(super) capacities: Capacities,
    pub(super) pool: Pool,
    pub(super) dispatch: Dispatch,
    pub(super) anchors: Anchors,
    pub(super) features: Features,
    pub(super) decoders: Decoders,
    pub(super) decoder_grads: DecoderGradients,
    placements: Vec<KeyframePlacement>,
    pub(super) sky: Sky,
    pub(super) exposures: Exposures,
    pub(super) view: ViewBuffers,
    pub(super) loss: LossBuffers,
}

/// Why a backend cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// A capacity is impossible.
    #[error(transparent)]
    Capacity(#[from] CapacityError),
    /// The machine lacks the instruction set.
    #[error("this machine has no {level}: use --simd auto, which takes {best} here")]
    Simd {
        /// What was asked for.
        level: SimdLevel,
        /// The best one present.
        best: SimdLevel,
    },
    /// The operating system refused a thread.
    #[error("starting {threads} splat threads: {source}: use fewer with --threads")]
    Threads {
        /// What was asked for.
        threads: usize,
        /// What the system said.
        source: std::io::Error,
    },
}

impl CpuBackend {
    /// Allocates everything and starts `threads - 1` workers; `on_thread_start` runs first on each of them.
    ///
    /// # Errors
    /// [`OpenError`]: an impossible capacity, a missing instruction set, a refused thread.
    pub fn new(
        capacities: Capacities,
        threads: usize,
        level: SimdLevel,
        on_thread_start: impl Fn(usize) + Send + Sync + 'static,
    ) -> Result<Self, OpenError> {
        let capacities = capacities.checked()?;
        let dispatch = Dispatch::new(level).ok_or_else(|| OpenError::Simd { level, best: SimdLevel::best() })?;
        let pool = Pool::new(threads, on_thread_start).map_err(|source| OpenError::Threads { threads, source })?;
        let n_pixels = capacities.image_width_px as usize * capacities.image_height_px as usize;
        let n_gaussians = capacities.anchors * capacities.gaussians_per_anchor;
        let n_shown = if capacities.learned_decoder { n_gaussians } else { 0 };
        Ok(Self {
            capacities,
            pool,
            dispatch,
            anchors: Anchors::new(&capacities),
            features: Features::new(&capacities),
            decoders: Decoders::new(&capacities),
            decoder_grads: DecoderGradients::new(&capacities),
            placements: vec![KeyframePlacement::identity(); capacities.keyframe_rows],
            sky: Sky::new(capacities.chunk_rows),
            exposures: Exposures::new(capacities.exposure_slots),
            view: ViewBuffers {
                lists: Lists::new(&capacities),
                keyframes: vec![[0.0; 12]; capacities.keyframe_rows],
                cameras_in_keyframe_m: vec![[0.0; 3]; capacities.keyframe_rows],
                shown: vec![FromZeros::new_zeroed(); n_shown],
                planes: vec![0.0; N_DRAWN * n_pixels],
                clock: StageClock::new(),
            },
            loss: LossBuffers::new(&capacities),
        })
    }

    /// The instruction set in use.
    pub fn simd_level(&self) -> SimdLevel {
        self.dispatch.level
    }

    /// Threads in use, the caller's included.
    pub fn threads(&self) -> usize {
        self.pool.threads()
    }

    /// What a backend of these capacities allocates, row by row.
    pub fn memory_plan(capacities: &Capacities) -> [MemoryRow; 10] {
        let row = |name, elements, bytes_per_element| MemoryRow { name, elements, bytes_per_element };
        let n_pixels = capacities.image_width_px as usize * capacities.image_height_px as usize;
        let placement_bytes = size_of::<KeyframePlacement>() + size_of::<KeyframeNumbers>() + size_of::<[f32; 3]>();
        let k = capacities.gaussians_per_anchor;
        let mut slot = slot_bytes(k) + size_of::<u32>();
        // Gradients of the one chunk that is trained.
        let (mut chunk_row, mut gradients) = (SKY_ROW_BYTES, SKY_GRADIENT_BYTES);
        if capacities.learned_decoder {
            slot += FEATURE_BYTES + k * size_of::<GaussianParams>();
            chunk_row += decoder_row_bytes(k);
            gradients += decoder_gradient_bytes(k);
        }
        [
            row("splat.anchors", capacities.anchors, slot),
            row("splat.visible_gaussians", capacities.visible_gaussians, VISIBLE_BYTES),
            row("splat.row_entries", capacities.row_entries, ROW_ENTRY_BYTES),
            row("splat.pairs", capacities.pairs, PAIR_BYTES),
            row("splat.image_pixels", n_pixels, N_DRAWN * size_of::<f32>()),
            row("splat.training_pixels", capacities.training_pixels, TRAINING_PIXEL_BYTES),
            row("splat.keyframe_rows", capacities.keyframe_rows, placement_bytes),
            row("splat.chunk_rows", capacities.chunk_rows, chunk_row),
            row("splat.chunk_gradients", 1, gradients),
            row("splat.exposure_slots", capacities.exposure_slots, EXPOSURE_BYTES),
        ]
    }

    pub(super) fn draw(&mut self, view: &View) -> Drawn {
        let machine = Machine { pool: &self.pool, dispatch: self.dispatch };
        let map = Map {
            anchors: &self.anchors,
            features: &self.features,
            decoders: &self.decoders,
            placements: &self.placements,
            texels: self.sky.row(view.chunk_row).unwrap_or_default(),
        };
        self.view.draw(machine, &map, view)
    }
}

fn refused_step() -> StepReport {
    StepReport { stats: RenderStats { refused: true, ..RenderStats::default() }, ..StepReport::default() }
}

impl SplatBackend for CpuBackend {
    fn capacities(&self) -> &Capacities {
        &self.capacities
    }

    fn write_anchors(&mut self, slots: &[u32], headers: &[AnchorHeader], params: &[GaussianParams]) -> usize {
        let (k, rows) = (self.anchors.k, self.capacities.keyframe_rows);
        let mut refused = slots.len();
        for ((&slot, header), params) in slots.iter().zip(headers).zip(params.chunks(k)) {
            if self.anchors.write(slot, header, params, rows) {
                self.features.write(slot, &NO_FEATURE);
                refused -= 1;
            }
        }
        refused
    }

    fn read_anchors(&self, slots: &[u32], headers: &mut [AnchorHeader], params: &mut [GaussianParams]) -> usize {
        let read = slots.iter().zip(headers).zip(params.chunks_mut(self.anchors.k));
        slots.len()
            - read.filter_map(|((&slot, header), params)| self.anchors.read(slot, header, params).then_some(())).count()
    }

    fn write_features(&mut self, slots: &[u32], features: &[AnchorFeature]) -> usize {
        let written = slots.iter().zip(features).filter(|&(&slot, feature)| self.features.write(slot, feature));
        slots.len() - written.count()
    }

    fn read_features(&self, slots: &[u32], features: &mut [AnchorFeature]) -> usize {
        let read = slots.iter().zip(features).filter_map(|(&slot, feature)| {
            *feature = *self.features.values().get(slot as usize)?;
            Some(())
        });
        slots.len() - read.count()
    }

    fn retire_anchors(&mut self, slots: &[u32]) -> usize {
        slots.iter().filter(|&&slot| !self.anchors.retire(slot)).count()
    }

    fn set_keyframes(&mut self, first_row: u32, placements: &[KeyframePlacement]) -> usize {
        let rows = self.placements.get_mut(first_row as usize..).unwrap_or_default();
        let n = rows.len().min(placements.len());
        rows[..n].copy_from_slice(&placements[..n]);
        placements.len() - n
    }

    fn write_background(&mut self, chunk_row: u16, texels: &[[f32; 3]]) -> bool {
        self.sky.write(chunk_row, texels)
    }

    fn read_background(&self, chunk_row: u16, texels: &mut [[f32; 3]]) -> bool {
        match self.sky.row(chunk_row).filter(|row| row.len() == texels.len()) {
            Some(row) => {
                texels.copy_from_slice(row);
                true
            }
            None => false,
        }
    }

    fn write_decoder(&mut self, chunk_row: u16, weights: &[f32]) -> bool {
        self.decoders.write(chunk_row, weights)
    }

    fn read_decoder(&self, chunk_row: u16, weights: &mut [f32]) -> bool {
        match self.decoders.row(chunk_row).filter(|decoder| decoder.weights().len() == weights.len()) {
            Some(decoder) => {
                weights.copy_from_slice(decoder.weights());
                true
            }
            None => false,
        }
    }

    fn write_exposure(&mut self, slot: u32, exposure: Exposure) -> bool {
        self.exposures.set(slot, exposure)
    }

    fn read_exposure(&self, slot: u32) -> Option<Exposure> {
        self.exposures.get(slot)
    }

    fn render(&mut self, view: &View, target: RenderTarget<'_>) -> RenderStats {
        let n_pixels = view.n_pixels();
        let lengths = [target.rgb.len(), target.depth_m.len(), target.transmittance.len()];
        if !self.capacities.fits(view) || lengths != [n_pixels; 3] {
            return RenderStats { refused: true, ..RenderStats::default() };
        }
        let drawn = self.draw(view);
        let [red, green, blue, depth_m, transmittance] = self.view.drawn(n_pixels);
        for (((rgb, &r), &g), &b) in target.rgb.iter_mut().zip(red).zip(green).zip(blue) {
            *rgb = [r, g, b];
        }
        target.depth_m.copy_from_slice(depth_m);
        target.transmittance.copy_from_slice(transmittance);
        drawn.stats
    }

    fn train_step(&mut self, training: &TrainingView<'_>, settings: &StepSettings) -> StepReport {
        if !self.capacities.fits_training(training) {
            return refused_step();
        }
        let mut pass = self.pass(training, settings, Collected::default());
        let progress = settings.progress;
        self.sky.step(training.view.chunk_row, settings.rates.background.at(progress));
        if let Some(slot) = training.exposure_slot {
            let weight = settings.weights.exposure;
            let rate = settings.rates.exposure.at(progress);
            pass.report.loss.exposure = self.exposures.step(slot, &pass.exposure_gradient, weight, rate);
            pass.report.loss.total += weight * pass.report.loss.exposure;
        }
        self.view.clock.finish("sky");
        pass.report
    }

    fn score_view(
        &mut self,
        training: &TrainingView<'_>,
        error_threshold: f32,
        scores: &mut [AnchorScore],
    ) -> ScoreReport {
        if !self.capacities.fits_training(training) || scores.len() != self.capacities.anchors {
            return ScoreReport::refused();
        }
        self.score(training, error_threshold, scores)
    }

    fn stage_times(&self) -> StageTimes {
        self.view.clock.times().clone()
    }
}
