//! The backend of a device: host bookkeeping around one executor.

use super::error::DeviceError;
use super::executor::Executor;
use super::runs::{Device, refused};
use super::slots::Slots;
use super::view::view_block;
use crate::splat::cpu::exposures::Exposures;
use crate::splat::cpu::sky::INITIAL_COLOR;
use crate::splat::layout::{DeviceAnchor, KeyframeBlock, ViewBlock};
use crate::splat::program::{Buffer, FEATURE_MOMENTS, TEXEL_NUMBERS, buffer_plan};
use crate::splat::{
    AnchorFeature, AnchorHeader, AnchorScore, BACKGROUND_TEXELS, Capacities, DecoderShape, Exposure, GaussianParams,
    KeyframePlacement, MemoryRow, RenderStats, RenderTarget, ScoreReport, SplatBackend, StageClock, StageTimes,
    StepReport, StepSettings, TrainingView, View,
};
use std::ops::Range;
use zerocopy::IntoBytes;

/// Splatting on a device.
///
/// When the device is lost, [`failure`](Self::failure) says why, every view is refused and reads fail; the caller
/// rebuilds the map on another backend.
pub struct DeviceBackend<E> {
    pub(super) capacities: Capacities,
    pub(super) device: Device<E>,
    pub(super) slots: Slots,
    pub(super) placements: Vec<KeyframePlacement>,
    pub(super) keyframes: Vec<KeyframeBlock>,
    pub(super) exposures: Exposures,
    /// Red, green, blue on their way from the device.
    planes: Vec<f32>,
    /// Adam steps of each background.
    pub(super) background_steps: Vec<u32>,
    /// Adam steps of each decoder; empty when none is learned.
    pub(super) decoder_steps: Vec<u32>,
    /// Zeros for the moments of [`SLOTS_PER_UPLOAD`] slots.
    zeros: Vec<u8>,
    /// Set when every stage is run and waited for on its own.
    pub(super) clock: Option<StageClock>,
}

impl<E: Executor> DeviceBackend<E> {
    /// A backend of these capacities on an executor that was opened for them.
    ///
    /// # Errors
    /// What the executor says when the first numbers are uploaded.
    pub fn new(capacities: Capacities, mut executor: E) -> Result<Self, DeviceError> {
        for (digit, buffer) in [Buffer::Digit0, Buffer::Digit1, Buffer::Digit2, Buffer::Digit3].into_iter().enumerate()
        {
            executor.upload(buffer, 0, (digit as u32).as_bytes())?;
        }
        let texels = [INITIAL_COLOR; BACKGROUND_TEXELS];
        for row in 0..capacities.chunk_rows {
            executor.upload(Buffer::Texels, row * size_of_val(&texels), texels.as_bytes())?;
        }
        let k = capacities.gaussians_per_anchor;
        let n_pixels = capacities.image_width_px as usize * capacities.image_height_px as usize;
        Ok(Self {
            device: Device::new(executor),
            slots: Slots::new(&capacities),
            placements: vec![KeyframePlacement::identity(); capacities.keyframe_rows],
            keyframes: vec![KeyframeBlock::default(); capacities.keyframe_rows],
            exposures: Exposures::new(capacities.exposure_slots),
            planes: vec![0.0; 3 * n_pixels],
            background_steps: vec![0; capacities.chunk_rows],
            decoder_steps: vec![0; if capacities.learned_decoder { capacities.chunk_rows } else { 0 }],
            zeros: vec![0; SLOTS_PER_UPLOAD * (k * size_of::<GaussianParams>()).max(FEATURE_MOMENT_BYTES)],
            clock: None,
            capacities,
        })
    }

    /// Why the device stopped working, if it did.
    pub fn failure(&self) -> Option<String> {
        let failure = self.device.failure.borrow();
        failure.as_ref().map(|error| {
            // Asked for once, when the device is given up.
            let _allocates = crate::seal::lift();
            error.to_string()
        })
    }

    /// Name of the device.
    pub fn device_name(&self) -> String {
        self.device.executor.borrow().device_name().to_owned()
    }

    /// Bytes of device memory in use.
    pub fn device_bytes(&self) -> usize {
        self.device.executor.borrow().device_bytes()
    }

    /// Whether every stage is run and waited for on its own, so that
    /// [`stage_times`](SplatBackend::stage_times) can tell them apart; slower, and the same results.
    pub fn time_stages(&mut self, on: bool) {
        self.clock = on.then(StageClock::new);
    }

    /// What a device backend of these capacities takes on the device, row by row.
    pub fn memory_plan(capacities: &Capacities) -> [MemoryRow; Buffer::ALL.len()] {
        buffer_plan(capacities)
    }

    pub(super) fn block(&self, view: &View) -> ViewBlock {
        view_block(&self.capacities, view, self.slots.end() as u32)
    }

    fn has_feature(&self, slot: u32) -> bool {
        self.capacities.learned_decoder && (slot as usize) < self.capacities.anchors
    }

    /// Fills consecutive slots and restarts their moments.
    fn upload_anchors(&self, first: usize, anchors: &[DeviceAnchor], params: &[GaussianParams]) -> bool {
        let at = first * self.capacities.gaussians_per_anchor;
        let zeros = &self.zeros[..size_of_val(params)];
        let steps = &self.zeros[..params.len() * size_of::<u32>()];
        self.device.call(|e| {
            e.upload(Buffer::Anchors, first * size_of::<DeviceAnchor>(), anchors.as_bytes())?;
            e.upload(Buffer::Params, at * size_of::<GaussianParams>(), params.as_bytes())?;
            e.upload(Buffer::ParamFirst, at * size_of::<GaussianParams>(), zeros)?;
            e.upload(Buffer::ParamSecond, at * size_of::<GaussianParams>(), zeros)?;
            e.upload(Buffer::ParamSteps, at * size_of::<u32>(), steps)
        }) && self.upload_features(first, anchors.len(), None)
    }

    /// Sets features of consecutive slots and restarts their moments; anything without features is done at once.
    fn upload_features(&self, first: usize, n: usize, features: Option<&[AnchorFeature]>) -> bool {
        if !self.capacities.learned_decoder {
            return true;
        }
        let values = features.map_or(&self.zeros[..n * size_of::<AnchorFeature>()], |features| features.as_bytes());
        let zeros = &self.zeros[..n * FEATURE_MOMENT_BYTES];
        self.device.call(|e| {
            e.upload(Buffer::Features, first * size_of::<AnchorFeature>(), values)?;
            e.upload(Buffer::FeatureMoments, first * FEATURE_MOMENT_BYTES, zeros)
        })
    }

    /// Where a chunk row's decoder of `len` numbers begins; `None` when there is no such decoder.
    fn decoder_offset(&self, chunk_row: u16, len: usize) -> Option<usize> {
        let shape = DecoderShape::new(self.capacities.gaussians_per_anchor);
        let row = usize::from(chunk_row);
        (row < self.decoder_steps.len() && len == shape.len()).then_some(row * len * size_of::<f32>())
    }
}

/// Most anchors that are uploaded together: a call costs more than the bytes of one of them.
const SLOTS_PER_UPLOAD: usize = 64;

/// Index of the next slot of a run of `len` consecutive slots from `first` on.
fn next_of_run(slots: &[u32], first: usize, len: usize) -> Option<usize> {
    let next = slots[first].checked_add(len as u32)?;
    (len < SLOTS_PER_UPLOAD && slots.get(first + len) == Some(&next)).then_some(first + len)
}

/// Runs of consecutive slots that are used, each with its place among `slots`: they come from the device together.
fn neighbours(slots: &[u32], is_used: impl Fn(u32) -> bool) -> impl Iterator<Item = (Range<usize>, &[u32])> {
    let is_used = move |index: usize| is_used(slots[index]);
    let mut first = 0;
    core::iter::from_fn(move || {
        first = (first..slots.len()).find(|&index| is_used(index))?;
        let follows = |&index: &usize| slots[index - 1].checked_add(1) == Some(slots[index]) && is_used(index);
        let end = first + 1 + (first + 1..slots.len()).take_while(follows).count();
        let run = first..end;
        first = end;
        Some((run.clone(), &slots[run]))
    })
}

/// Bytes of [`Buffer::FeatureMoments`] per slot.
const FEATURE_MOMENT_BYTES: usize = FEATURE_MOMENTS * size_of::<f32>();

impl<E: Executor> SplatBackend for DeviceBackend<E> {
    fn capacities(&self) -> &Capacities {
        &self.capacities
    }

    fn write_anchors(&mut self, slots: &[u32], headers: &[AnchorHeader], params: &[GaussianParams]) -> usize {
        let k = self.capacities.gaussians_per_anchor;
        let n = slots.len().min(headers.len()).min(params.len() / k);
        let (mut refused, mut first) = (slots.len(), 0);
        while first < n {
            let mut run = heapless::Vec::<DeviceAnchor, SLOTS_PER_UPLOAD>::new();
            while let Some(i) = next_of_run(&slots[..n], first, run.len()) {
                let own = &params[i * k..(i + 1) * k];
                let Some(anchor) = self.slots.write(&self.capacities, slots[i], &headers[i], own) else { break };
                if run.push(anchor).is_err() {
                    unreachable!("next_of_run ends before SLOTS_PER_UPLOAD");
                }
            }
            let filled = &params[first * k..(first + run.len()) * k];
            if !run.is_empty() && self.upload_anchors(slots[first] as usize, &run, filled) {
                refused -= run.len();
            }
            // One that is refused is a run of none.
            first += run.len().max(1);
        }
        refused
    }

    fn read_anchors(&self, slots: &[u32], headers: &mut [AnchorHeader], params: &mut [GaussianParams]) -> usize {
        let k = self.capacities.gaussians_per_anchor;
        let mut missing = slots.len();
        for (range, run) in neighbours(slots, |slot| self.slots.header(slot).is_some()) {
            let (headers, params) = (headers.get_mut(range.clone()), params.get_mut(range.start * k..range.end * k));
            let (Some(headers), Some(params)) = (headers, params) else { continue };
            let at = run[0] as usize * k * size_of::<GaussianParams>();
            if self.device.call(|e| e.download(Buffer::Params, at, params.as_mut_bytes())) {
                let found = run.iter().filter_map(|&slot| self.slots.header(slot));
                headers.iter_mut().zip(found).for_each(|(header, found)| *header = *found);
                missing -= run.len();
            }
        }
        missing
    }

    fn write_features(&mut self, slots: &[u32], features: &[AnchorFeature]) -> usize {
        let written = slots.iter().zip(features).filter(|&(&slot, feature)| {
            let fits = self.has_feature(slot) && feature.iter().all(|v| v.is_finite());
            fits && self.upload_features(slot as usize, 1, Some(core::slice::from_ref(feature)))
        });
        slots.len() - written.count()
    }

    fn read_features(&self, slots: &[u32], features: &mut [AnchorFeature]) -> usize {
        let mut missing = slots.len();
        for (range, run) in neighbours(slots, |slot| self.has_feature(slot)) {
            let Some(features) = features.get_mut(range) else { continue };
            let at = run[0] as usize * size_of::<AnchorFeature>();
            if self.device.call(|e| e.download(Buffer::Features, at, features.as_mut_bytes())) {
                missing -= run.len();
            }
        }
        missing
    }

    fn retire_anchors(&mut self, slots: &[u32]) -> usize {
        let mut missing = 0;
        for &slot in slots {
            match self.slots.retire(slot) {
                Some(anchor) => {
                    let at = slot as usize * size_of::<DeviceAnchor>();
                    self.device.call(|e| e.upload(Buffer::Anchors, at, anchor.as_bytes()));
                }
                None => missing += 1,
            }
        }
        missing
    }

    fn set_keyframes(&mut self, first_row: u32, placements: &[KeyframePlacement]) -> usize {
        let rows = self.placements.get_mut(first_row as usize..).unwrap_or_default();
        let n = rows.len().min(placements.len());
        rows[..n].copy_from_slice(&placements[..n]);
        placements.len() - n
    }

    fn write_background(&mut self, chunk_row: u16, texels: &[[f32; 3]]) -> bool {
        let row = usize::from(chunk_row);
        let fits = row < self.capacities.chunk_rows && texels.len() == BACKGROUND_TEXELS;
        if !fits || !texels.as_flattened().iter().all(|v| v.is_finite()) {
            return false;
        }
        self.background_steps[row] = 0;
        let (at, len) = (row * size_of_val(texels), size_of_val(texels));
        self.device.call(|e| {
            e.upload(Buffer::Texels, at, texels.as_bytes())?;
            e.clear(Buffer::TexelFirst, at, len)?;
            e.clear(Buffer::TexelSecond, at, len)
        })
    }

    fn read_background(&self, chunk_row: u16, texels: &mut [[f32; 3]]) -> bool {
        let row = usize::from(chunk_row);
        if row >= self.capacities.chunk_rows || texels.len() != BACKGROUND_TEXELS {
            return false;
        }
        let at = row * TEXEL_NUMBERS * size_of::<f32>();
        self.device.call(|e| e.download(Buffer::Texels, at, texels.as_mut_bytes()))
    }

    fn write_decoder(&mut self, chunk_row: u16, weights: &[f32]) -> bool {
        let fits = self.decoder_offset(chunk_row, weights.len()).filter(|_| weights.iter().all(|v| v.is_finite()));
        let Some(at) = fits else { return false };
        self.decoder_steps[usize::from(chunk_row)] = 0;
        let len = size_of_val(weights);
        self.device.call(|e| {
            e.upload(Buffer::Decoders, at, weights.as_bytes())?;
            e.clear(Buffer::DecoderFirst, at, len)?;
            e.clear(Buffer::DecoderSecond, at, len)
        })
    }

    fn read_decoder(&self, chunk_row: u16, weights: &mut [f32]) -> bool {
        let found = self.decoder_offset(chunk_row, weights.len());
        found.is_some_and(|at| self.device.call(|e| e.download(Buffer::Decoders, at, weights.as_mut_bytes())))
    }

    fn write_exposure(&mut self, slot: u32, exposure: Exposure) -> bool {
        self.exposures.set(slot, exposure)
    }

    fn read_exposure(&self, slot: u32) -> Option<Exposure> {
        self.exposures.get(slot)
    }

    fn render(&mut self, view: &View, target: RenderTarget<'_>) -> RenderStats {
        let n = view.n_pixels();
        let lengths = [target.rgb.len(), target.depth_m.len(), target.transmittance.len()];
        let parts = self.drawing_then(&[]);
        if !self.capacities.fits(view) || lengths != [n; 3] || !self.run(view, &self.block(view), &parts) {
            return refused();
        }
        let plane_bytes = n * size_of::<f32>();
        let planes = &mut self.planes[..3 * n];
        let read = self.device.call(|e| {
            e.download(Buffer::Planes, 0, planes.as_mut_bytes())?;
            e.download(Buffer::Planes, 3 * plane_bytes, target.depth_m.as_mut_bytes())?;
            e.download(Buffer::Planes, 4 * plane_bytes, target.transmittance.as_mut_bytes())
        });
        let (red, rest) = planes.split_at(n);
        let (green, blue) = rest.split_at(n);
        for (((rgb, &r), &g), &b) in target.rgb.iter_mut().zip(red).zip(green).zip(blue) {
            *rgb = [r, g, b];
        }
        self.stats().filter(|_| read).unwrap_or_else(refused)
    }

    fn train_step(&mut self, training: &TrainingView<'_>, settings: &StepSettings) -> StepReport {
        self.train(training, settings)
    }

    fn score_view(
        &mut self,
        training: &TrainingView<'_>,
        error_threshold: f32,
        scores: &mut [AnchorScore],
    ) -> ScoreReport {
        self.score(training, error_threshold, scores)
    }

    fn stage_times(&self) -> StageTimes {
        self.clock.as_ref().map(|clock| clock.times().clone()).unwrap_or_default()
    }
}
