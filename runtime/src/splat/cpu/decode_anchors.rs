//! What is drawn of each anchor: its stored numbers plus what its chunk's decoder adds for this camera.

use super::anchors::FixedNumbers;
use super::cull::{Frustum, KeyframeNumbers, largest_scale, visibility_of};
use super::decoders::Decoders;
use super::draw::Machine;
use super::lane::Wide;
use super::layers::{BATCH, Layer, hidden_layer, outputs};
use super::packet::{as_gaussians, as_numbers, as_numbers_mut};
use super::splats::{MAX_JOBS, piece_len, take_front};
use crate::splat::kernel_constants::{MAX_SIGMAS, MOST_GROWTH, MOST_SHIFT};
use crate::splat::{AnchorFeature, GaussianParams, KeyframePlacement, View};
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN, INPUTS, VIEW_INPUTS, view_input, view_input_backward};
use pulp::{Simd, WithSimd};

/// Anchors, and from where they are seen.
#[derive(Clone, Copy)]
pub struct SeenAnchors<'a> {
    /// What never changes by training.
    pub fixed: FixedNumbers<'a>,
    /// The chunks' decoders.
    pub decoders: &'a Decoders,
    /// Camera from each keyframe row.
    pub keyframes: &'a [KeyframeNumbers],
    /// Where the camera is in each keyframe's frame, m.
    pub cameras_in_keyframe_m: &'a [[f32; 3]],
}

impl SeenAnchors<'_> {
    /// What the decoder reads of an anchor.
    pub fn inputs(&self, slot: usize, feature: &AnchorFeature, inputs: &mut [f32; INPUTS]) {
        let (features, seen) = inputs.split_at_mut(FEATURE_LEN);
        features.copy_from_slice(feature);
        seen.copy_from_slice(&view_input(self.anchor_from_camera_m(slot)));
    }

    /// How far the camera moves along its own axes for the loss to grow fastest, per m: the gradient with respect to
    /// the `upsilon` of its pose, from that with respect to the inputs that say from where an anchor is seen.
    pub fn camera_gradient(&self, slot: usize, view_grads: &[f32; VIEW_INPUTS]) -> [f32; 3] {
        let [x, y, z] = view_input_backward(self.anchor_from_camera_m(slot), view_grads);
        let m = &self.keyframes[self.fixed.headers[slot].keyframe_row as usize];
        // d(anchor_from_camera) = linear^T upsilon / scale^2, because the camera is at -R^T t in the map.
        let scale2 = m[0] * m[0] + m[1] * m[1] + m[2] * m[2];
        [0, 1, 2].map(|r| (m[3 * r] * x + m[3 * r + 1] * y + m[3 * r + 2] * z) / scale2)
    }

    fn anchor_from_camera_m(&self, slot: usize) -> [f32; 3] {
        let header = &self.fixed.headers[slot];
        let camera_m = &self.cameras_in_keyframe_m[header.keyframe_row as usize];
        [0, 1, 2].map(|i| header.position_in_keyframe_m[i] - camera_m[i])
    }
}

/// Where the camera is in the frame of every keyframe row, m.
pub fn place_camera(view: &View, placements: &[KeyframePlacement], out: &mut [[f32; 3]]) {
    let camera_in_map_m = view.camera_from_map.inverse().translation.vector;
    for (placement, camera_m) in placements.iter().zip(out) {
        let in_keyframe_m = placement.rotation.inverse() * (camera_in_map_m - placement.translation_m);
        *camera_m = (in_keyframe_m / placement.scale).map(|v| v as f32).into();
    }
}

/// Fills `shown` for every anchor that may meet the picture and marks its slot with a 1 in `marks`, others with a 0.
pub fn decode_anchors(
    machine: Machine<'_>,
    seen: SeenAnchors<'_>,
    (stored, features): (&[GaussianParams], &[AnchorFeature]),
    frustum: &Frustum,
    marks: &mut [u32],
    shown: &mut [GaussianParams],
) {
    let len = piece_len(marks.len());
    let n_numbers = seen.decoders.shape.outputs;
    let (stored, mut shown) = (as_numbers(stored), as_numbers_mut(shown));
    let mut jobs = heapless::Vec::<DecodeJob<'_>, MAX_JOBS>::new();
    for (i, marks) in marks.chunks_mut(len).enumerate() {
        let shown = take_front(&mut shown, len * n_numbers);
        let job = DecodeJob { seen, stored, features, frustum, first_slot: i * len, marks, shown };
        if jobs.push(job).is_err() {
            unreachable!("piece_len makes at most MAX_JOBS pieces");
        }
    }
    machine.pool.for_each(&mut jobs, |_, job| {
        job.mark();
        machine.dispatch.run(RunDecodeJob(job));
    });
}

struct DecodeJob<'a> {
    seen: SeenAnchors<'a>,
    stored: &'a [f32],
    features: &'a [AnchorFeature],
    frustum: &'a Frustum,
    first_slot: usize,
    marks: &'a mut [u32],
    shown: &'a mut [f32],
}

impl DecodeJob<'_> {
    fn mark(&mut self) {
        for i in 0..self.marks.len() {
            self.marks[i] = u32::from(self.may_be_shown(self.first_slot + i));
        }
    }

    fn may_be_shown(&self, slot: usize) -> bool {
        let SeenAnchors { fixed, keyframes, .. } = self.seen;
        let header = &fixed.headers[slot];
        let m = &keyframes[header.keyframe_row as usize];
        if header.n_gaussians == 0 || visibility_of(header, m) <= 0.0 {
            return false;
        }
        let [x, y, z] = header.position_in_keyframe_m;
        let in_camera = [0, 1, 2].map(|r| m[r * 3] * x + m[r * 3 + 1] * y + m[r * 3 + 2] * z + m[9 + r]);
        self.frustum.may_reach(in_camera, || {
            let n_numbers = self.seen.decoders.shape.outputs;
            let numbers = &self.stored[slot * n_numbers..(slot + 1) * n_numbers];
            let reach = as_gaussians(numbers).iter().take(usize::from(header.n_gaussians)).map(|g| {
                let [dx, dy, dz] = g.offset;
                let shift = (dx * dx + dy * dy + dz * dz).sqrt() + MOST_SHIFT;
                shift + MAX_SIGMAS * MOST_GROWTH * largest_scale(g)
            });
            let extent_m = fixed.extents_m[slot];
            let scale = (m[0] * m[0] + m[1] * m[1] + m[2] * m[2]).sqrt();
            scale * extent_m[0].max(extent_m[1]).max(extent_m[2]) * reach.fold(0.0, f32::max)
        })
    }
}

struct RunDecodeJob<'j, 'a>(&'j mut DecodeJob<'a>);

impl WithSimd for RunDecodeJob<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        let mut batch = Batch::new();
        for i in 0..job.marks.len() {
            if job.marks[i] == 0 {
                continue;
            }
            let slot = job.first_slot + i;
            let chunk_row = job.seen.fixed.headers[slot].chunk_row;
            if batch.is_closed_to(chunk_row) {
                batch.flush(simd, job);
                batch.chunk_row = chunk_row;
            }
            batch.push(&job.seen, slot, &job.features[slot]);
        }
        batch.flush(simd, job);
    }
}

/// Anchors of one chunk row on their way through its decoder.
pub struct Batch {
    pub chunk_row: u16,
    pub n: usize,
    pub slots: [usize; BATCH],
    pub inputs: Layer<INPUTS>,
    pub hidden: Layer<HIDDEN>,
}

impl Batch {
    /// No anchors.
    pub fn new() -> Self {
        Self { chunk_row: 0, n: 0, slots: [0; BATCH], inputs: Layer::ZERO, hidden: Layer::ZERO }
    }

    /// Whether an anchor of a chunk row has to wait until the batch is through.
    #[inline(always)]
    pub fn is_closed_to(&self, chunk_row: u16) -> bool {
        self.n == BATCH || self.chunk_row != chunk_row
    }

    /// Takes in an anchor with its feature.
    #[inline(always)]
    pub fn push(&mut self, seen: &SeenAnchors<'_>, slot: usize, feature: &AnchorFeature) {
        seen.inputs(slot, feature, &mut self.inputs.0[self.n]);
        self.slots[self.n] = slot;
        self.n += 1;
    }

    #[inline(always)]
    fn flush<S: Simd>(&mut self, simd: S, job: &mut DecodeJob<'_>) {
        let n_numbers = job.seen.decoders.shape.outputs;
        let n = core::mem::take(&mut self.n);
        let decoder = match job.seen.decoders.row(self.chunk_row) {
            Some(decoder) if !decoder.adds_nothing() => decoder,
            _ => {
                for &slot in &self.slots[..n] {
                    let at = (slot - job.first_slot) * n_numbers;
                    let stored = &job.stored[slot * n_numbers..(slot + 1) * n_numbers];
                    job.shown[at..at + n_numbers].copy_from_slice(stored);
                }
                return;
            }
        };
        if n == 0 {
            return;
        }
        hidden_layer(simd, decoder, &self.inputs, &mut self.hidden);
        for first in (0..n_numbers).step_by(S::F32_LANES) {
            let residuals = outputs(simd, decoder, &self.hidden, first);
            let end = (first + S::F32_LANES).min(n_numbers);
            for a in 0..BATCH {
                if a < n {
                    let (slot, at) = (self.slots[a], (self.slots[a] - job.first_slot) * n_numbers);
                    let stored = Wide::load(simd, &job.stored[slot * n_numbers + first..]);
                    (stored + residuals[a]).store(&mut job.shown[at + first..at + end]);
                }
            }
        }
    }
}
