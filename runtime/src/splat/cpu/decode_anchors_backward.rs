//! From gradients of what is drawn of each anchor to those of features and of the decoder that learns, and the
//! features' optimizer step, in one pass.
//!
//! The hidden layer is computed once more instead of being kept. Gradients of the decoder are summed in bands of
//! slots that do not depend on the thread count, and the bands are added in their order.

use super::adam::{BiasCorrection, adam};
use super::decode::N_PARAMS;
use super::decode_anchors::{Batch, SeenAnchors};
use super::decoders::{Decoder, DecoderRule, transpose};
use super::draw::Machine;
use super::features::FeatureStorage;
use super::lane::{Lane, Wide};
use super::layers::{BATCH, Layer, MAX_OUTPUTS, add_products, feature_grads, hidden_grads, hidden_layer};
use super::packet::as_arrays;
use super::pose::PoseSum;
use crate::splat::kernel_constants::MAX_GRADIENT;
use crate::splat::{Capacities, DecoderShape, GaussianParams};
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN, INPUTS, VIEW_INPUTS};
use pulp::{Simd, WithSimd};

/// Bands of slots whose gradients are summed on their own.
const BANDS: usize = 16;

/// Sums of the gradients of one decoder.
pub struct DecoderGradients {
    shape: DecoderShape,
    /// One per band: `W1`, `b1`, `W2` as `output * HIDDEN + hidden`, `b2`.
    bands: Vec<f32>,
    /// In the layout of the decoder.
    total: Vec<f32>,
}

/// Bytes of the sums.
pub const fn decoder_gradient_bytes(gaussians_per_anchor: usize) -> usize {
    (BANDS + 1) * DecoderShape::new(gaussians_per_anchor).len() * size_of::<f32>()
}

/// Gradients of what was drawn.
#[derive(Clone, Copy)]
pub struct ShownGradients<'a> {
    /// Gaussians of each slot that have a gradient, one bit each.
    pub visible: &'a [u32],
    /// One per Gaussian of every slot; anything where there is no bit.
    pub grads: &'a [GaussianParams],
}

impl DecoderGradients {
    /// Zeros; empty when the decoder is not learned.
    pub fn new(capacities: &Capacities) -> Self {
        let shape = DecoderShape::new(capacities.gaussians_per_anchor);
        let len = if capacities.learned_decoder { shape.len() } else { 0 };
        Self { shape, bands: vec![0.0; BANDS * len], total: vec![0.0; len] }
    }

    /// Gradients of the decoder that learns, as found last.
    pub fn total(&self) -> &[f32] {
        &self.total
    }

    /// Finds the gradients of the decoder of `rule.row`, takes a step with the features of all visible anchors, and
    /// returns the gradient of the camera's pose through what the decoders read of it, 0 unless it is wanted.
    pub fn find(
        &mut self,
        machine: Machine<'_>,
        seen: SeenAnchors<'_>,
        rule: &DecoderRule,
        shown: ShownGradients<'_>,
        mut features: FeatureStorage<'_>,
        pose_gradient: bool,
    ) -> PoseSum {
        let n_slots = shown.visible.len();
        let len = n_slots.div_ceil(BANDS).max(1);
        let mut jobs = heapless::Vec::<BandJob<'_>, BANDS>::new();
        for (i, sums) in self.bands.chunks_exact_mut(self.shape.len()).enumerate() {
            let first_slot = (i * len).min(n_slots);
            let end_slot = (first_slot + len).min(n_slots);
            let features = features.take_front(end_slot - first_slot);
            let pose = pose_gradient.then(PoseSum::default);
            if jobs.push(BandJob { seen, rule, shown, first_slot, end_slot, features, sums, pose }).is_err() {
                unreachable!("there are BANDS sums");
            }
        }
        machine.pool.for_each(&mut jobs, |_, job| machine.dispatch.run(RunBandJob(job)));
        let mut pose = PoseSum::default();
        jobs.iter().filter_map(|job| job.pose).for_each(|part| pose.add(part.0));
        drop(jobs);
        self.add_bands();
        pose
    }

    fn add_bands(&mut self) {
        let Self { shape, bands, total } = self;
        let (first, others) = bands.split_at_mut(shape.len());
        for band in others.chunks_exact(shape.len()) {
            for (sum, part) in first.iter_mut().zip(band) {
                *sum += part;
            }
        }
        total.copy_from_slice(first);
        let second_layer = shape.output_weights();
        transpose(&first[second_layer.clone()], HIDDEN, &mut total[second_layer]);
    }
}

struct BandJob<'a> {
    seen: SeenAnchors<'a>,
    rule: &'a DecoderRule,
    shown: ShownGradients<'a>,
    first_slot: usize,
    end_slot: usize,
    features: FeatureStorage<'a>,
    sums: &'a mut [f32],
    pose: Option<PoseSum>,
}

impl BandJob<'_> {
    /// Gradients of an anchor's numbers; false when all of them are 0, because nothing of it was seen.
    fn output_grads(&self, slot: usize, out: &mut [f32; MAX_OUTPUTS]) -> bool {
        let k = self.seen.fixed.k;
        let mut any = false;
        let gaussians = as_arrays(&self.shown.grads[slot * k..(slot + 1) * k]);
        for (i, (gaussian, out)) in gaussians.iter().zip(out.chunks_exact_mut(N_PARAMS)).enumerate() {
            let is_visible = self.shown.visible[slot] >> i & 1 == 1;
            for (&grad, out) in gaussian.iter().zip(out) {
                // What is not a number is not below the bound.
                *out = if is_visible && grad.abs() < MAX_GRADIENT { grad } else { 0.0 };
                any |= *out != 0.0;
            }
        }
        any
    }
}

struct RunBandJob<'j, 'a>(&'j mut BandJob<'a>);

impl WithSimd for RunBandJob<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        job.sums.fill(0.0);
        let mut batch = BatchBack::new();
        for slot in job.first_slot..job.end_slot {
            if job.shown.visible[slot] == 0 {
                continue;
            }
            let chunk_row = job.seen.fixed.headers[slot].chunk_row;
            if batch.there.is_closed_to(chunk_row) {
                batch.flush(simd, job);
                batch.there.chunk_row = chunk_row;
            }
            batch.push(slot, job);
        }
        batch.flush(simd, job);
    }
}

/// Anchors of one chunk row on their way back through its decoder.
struct BatchBack {
    there: Batch,
    hidden_grads: Layer<HIDDEN>,
    output_grads: Layer<MAX_OUTPUTS>,
}

impl BatchBack {
    fn new() -> Self {
        Self { there: Batch::new(), hidden_grads: Layer::ZERO, output_grads: Layer::ZERO }
    }

    #[inline(always)]
    fn push(&mut self, slot: usize, job: &BandJob<'_>) {
        if job.output_grads(slot, &mut self.output_grads.0[self.there.n]) {
            self.there.push(&job.seen, slot, &job.features.values[slot - job.first_slot]);
        }
    }

    #[inline(always)]
    fn flush<S: Simd>(&mut self, simd: S, job: &mut BandJob<'_>) {
        let n = core::mem::take(&mut self.there.n);
        let Some(decoder) = job.seen.decoders.row(self.there.chunk_row).filter(|_| n > 0) else { return };
        for a in n..BATCH {
            self.output_grads.0[a][..decoder.outputs()].fill(0.0);
        }
        hidden_layer(simd, decoder, &self.there.inputs, &mut self.there.hidden);
        let learns = job.rule.row == Some(self.there.chunk_row);
        let (w1_b1, w2_b2) = job.sums.split_at_mut(decoder.first_layer_len());
        let (w1, b1) = w1_b1.split_at_mut(INPUTS * HIDDEN);
        let (w2, b2) = w2_b2.split_at_mut(HIDDEN * decoder.outputs());
        for first in (0..HIDDEN).step_by(S::F32_LANES) {
            let grads = hidden_grads(simd, decoder, &self.output_grads, &self.there.hidden, first);
            let mut units = [Wide::splat(simd, 0.0); BATCH];
            for a in 0..BATCH {
                grads[a].store(&mut self.hidden_grads.0[a][first..]);
                units[a] = Wide::load(simd, &self.there.hidden.0[a][first..]);
            }
            if learns {
                add_products(simd, &self.there.inputs, &grads, w1, first);
                add_products(simd, &self.output_grads, &units, w2, first);
                let mut sum = Wide::load(simd, &b1[first..]);
                for a in 0..BATCH {
                    sum = sum + grads[a];
                }
                sum.store(&mut b1[first..]);
            }
        }
        if learns {
            for a in 0..n {
                for (sum, grad) in b2.iter_mut().zip(&self.output_grads.0[a]) {
                    *sum += grad;
                }
            }
        }
        if let Some(pose) = &mut job.pose {
            self.add_pose_gradients(simd, decoder, n, &job.seen, pose);
        }
        self.step_features(simd, decoder, n, job);
    }

    #[inline(always)]
    fn add_pose_gradients<S: Simd>(
        &self,
        simd: S,
        decoder: &Decoder,
        n: usize,
        seen: &SeenAnchors<'_>,
        pose: &mut PoseSum,
    ) {
        for (slot, hidden_grads) in self.there.slots[..n].iter().zip(&self.hidden_grads.0) {
            let mut view_grads = [0.0; VIEW_INPUTS];
            for (grad, weights) in view_grads.iter_mut().zip(decoder.view_weights().chunks_exact(HIDDEN)) {
                let mut sum = Wide::splat(simd, 0.0);
                for first in (0..HIDDEN).step_by(S::F32_LANES) {
                    sum = Wide::load(simd, &weights[first..]).mul_add(Wide::load(simd, &hidden_grads[first..]), sum);
                }
                *grad = sum.sum();
            }
            let [x, y, z] = seen.camera_gradient(*slot, &view_grads).map(f64::from);
            pose.add([0.0, 0.0, 0.0, x, y, z]);
        }
    }

    #[inline(always)]
    fn step_features<S: Simd>(&self, simd: S, decoder: &Decoder, n: usize, job: &mut BandJob<'_>) {
        let rate = job.rule.feature_rate;
        let storage = &mut job.features;
        if storage.collected.is_none() && rate <= 0.0 {
            return;
        }
        let mut steps = [1.0f32; BATCH];
        for a in 0..n {
            let taken = &mut storage.steps[self.there.slots[a] - job.first_slot];
            if storage.collected.is_none() {
                *taken = taken.saturating_add(1);
            }
            steps[a] = f32::from(*taken);
        }
        for first in (0..FEATURE_LEN).step_by(S::F32_LANES) {
            let grads = feature_grads(simd, decoder, &self.hidden_grads, first);
            for a in 0..BATCH {
                if a >= n {
                    break;
                }
                let at = self.there.slots[a] - job.first_slot;
                if let Some(collected) = &mut storage.collected {
                    grads[a].store(&mut collected[at][first..]);
                    continue;
                }
                let correction = BiasCorrection::at(Wide::splat(simd, steps[a]));
                let [value, mean, square] = adam(
                    Wide::load(simd, &storage.values[at][first..]),
                    Wide::load(simd, &storage.first[at][first..]),
                    Wide::load(simd, &storage.second[at][first..]),
                    grads[a],
                    Wide::splat(simd, rate),
                    &correction,
                );
                value.store(&mut storage.values[at][first..]);
                mean.store(&mut storage.first[at][first..]);
                square.store(&mut storage.second[at][first..]);
            }
        }
    }
}
