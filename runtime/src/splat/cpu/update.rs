//! From gradients of splats to gradients of trained numbers, and the optimizer's step, in one pass.
//!
//! Decoding and projection are computed once more instead of being kept.

use super::adam::{BiasCorrection, adam};
use super::anchors::{Anchors, FixedNumbers, Moments};
use super::cull::fade_of;
use super::decode::{Decoded, N_PARAMS, decode, decode_backward, group};
use super::draw::Machine;
use super::lane::{Lane, Wide, each};
use super::packet::{PACKET, Packet, PacketLanes, Row, ZERO_ROW, as_arrays_mut};
use super::pose::PoseSum;
use super::project::{Projected, SplatGradient, project, project_backward};
use super::splats::{GRAD_COLOR, GRAD_DEPTH, Lists, MAX_JOBS, N_SPLAT_GRADS, piece_len, take_front};
use super::splatting::CameraView;
use crate::splat::{ChunkRows, GaussianParams};
use pulp::{Simd, WithSimd};

/// How the optimizer steps.
#[derive(Clone, Copy, Debug)]
pub struct UpdateRule {
    /// Adam step size of each trained number.
    pub rates: [f32; N_PARAMS],
    /// Weight of a single Gaussian's anisotropy in the loss.
    pub isotropy_weight: f32,
    /// Whether the gradient of the camera's pose is wanted.
    pub pose_gradient: bool,
    /// Chunk rows whose anchors have no gradient.
    pub finished: ChunkRows,
}

impl UpdateRule {
    fn is_frozen(&self) -> bool {
        self.rates.iter().all(|&rate| rate <= 0.0)
    }
}

/// Sums over the visible Gaussians.
#[derive(Clone, Copy, Debug, Default)]
pub struct UpdateSums {
    /// Of their anisotropies.
    pub anisotropy: f64,
    /// Of their gradients with respect to the camera's pose, when the rule asks for it.
    pub pose: PoseSum,
}

/// What one pass reads and writes.
pub struct UpdateTarget<'a> {
    /// Stored numbers, which take a step.
    pub anchors: &'a mut Anchors,
    /// Numbers as they were drawn, when that is not as stored; the gradients of all candidates take their place.
    pub shown: Option<&'a mut [GaussianParams]>,
    /// Where gradients go instead of a step being taken; as many elements as there are Gaussians.
    pub collected: Option<&'a mut [[f32; N_PARAMS]]>,
}

/// Takes a step with every visible Gaussian, or only writes the gradients.
pub fn update(
    machine: Machine<'_>,
    view: CameraView<'_>,
    n_candidates: usize,
    rule: &UpdateRule,
    target: UpdateTarget<'_>,
    lists: &Lists,
) -> UpdateSums {
    let (fixed, params, moments, steps) = target.anchors.split();
    let shown = target.shown.map(as_arrays_mut);
    let mut storage = Storage { params: as_arrays_mut(params), shown, moments, steps, collected: target.collected };
    let candidates = &lists.candidates[..n_candidates];
    let n_gaussians = storage.params.len();
    let len = piece_len(n_candidates);
    let mut jobs = heapless::Vec::<UpdateJob<'_>, MAX_JOBS>::new();
    let (mut start, mut first_id) = (0, 0);
    while start < n_candidates {
        let end = end_of_slot(candidates, (start + len).min(n_candidates), fixed.k);
        // Everything up to the first slot of the next piece.
        let end_id = candidates.get(end).map_or(n_gaussians, |&id| id as usize / fixed.k * fixed.k);
        let storage = storage.take_front(end_id - first_id);
        let job = UpdateJob { view, fixed, lists, rule, start, end, first_id, storage, sums: UpdateSums::default() };
        if jobs.push(job).is_err() {
            unreachable!("piece_len makes at most MAX_JOBS pieces");
        }
        (start, first_id) = (end, end_id);
    }
    machine.pool.for_each(&mut jobs, |_, job| machine.dispatch.run(RunUpdateJob(job)));
    let mut sums = UpdateSums::default();
    for job in &jobs {
        sums.anisotropy += job.sums.anisotropy;
        sums.pose.add(job.sums.pose.0);
    }
    sums
}

/// The first position from `at` on where a new slot begins.
fn end_of_slot(candidates: &[u32], at: usize, k: usize) -> usize {
    let slot = |i: usize| candidates[i] as usize / k;
    let mut end = at;
    while end < candidates.len() && slot(end) == slot(end - 1) {
        end += 1;
    }
    end
}

struct Storage<'a> {
    params: &'a mut [[f32; N_PARAMS]],
    shown: Option<&'a mut [[f32; N_PARAMS]]>,
    moments: &'a mut [Moments],
    steps: &'a mut [u16],
    collected: Option<&'a mut [[f32; N_PARAMS]]>,
}

impl<'a> Storage<'a> {
    fn take_front(&mut self, n: usize) -> Self {
        Storage {
            params: take_front(&mut self.params, n),
            shown: self.shown.as_mut().map(|rest| take_front(rest, n)),
            moments: take_front(&mut self.moments, n),
            steps: take_front(&mut self.steps, n),
            collected: self.collected.as_mut().map(|rest| take_front(rest, n)),
        }
    }
}

struct UpdateJob<'a> {
    view: CameraView<'a>,
    fixed: FixedNumbers<'a>,
    lists: &'a Lists,
    rule: &'a UpdateRule,
    start: usize,
    end: usize,
    /// Gaussian of the first element of `storage`.
    first_id: usize,
    storage: Storage<'a>,
    sums: UpdateSums,
}

struct RunUpdateJob<'j, 'a>(&'j mut UpdateJob<'a>);

impl WithSimd for RunUpdateJob<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        let mut work = Work::new();
        let mut ids = [0u32; PACKET];
        let mut n = 0;
        for i in job.start..job.end {
            let rank = job.lists.ranks[i];
            if rank != u32::MAX {
                ids[n] = job.lists.candidates[i];
                work.set_splat_gradient(n, &job.lists.splat_grads[rank as usize]);
                n += 1;
            } else if let Some(shown) = &mut job.storage.shown {
                shown[job.lists.candidates[i] as usize - job.first_id] = [0.0; N_PARAMS];
            }
            if n == PACKET || (i + 1 == job.end && n > 0) {
                job.run_packet(simd, &ids[..n], &mut work);
                n = 0;
            }
        }
    }
}

impl UpdateJob<'_> {
    /// What is finished has no gradient; without one and without moments it stays as it is.
    #[inline(always)]
    fn spare_finished(&self, ids: &[u32], work: &mut Work) {
        if self.rule.finished == ChunkRows::NONE {
            return;
        }
        for (lane, &id) in ids.iter().enumerate() {
            if self.rule.finished.contains(self.fixed.headers[id as usize / self.fixed.k].chunk_row) {
                work.param_grads.iter_mut().for_each(|row| row.0[lane] = 0.0);
            }
        }
    }

    #[inline(always)]
    fn run_packet<S: Simd>(&mut self, simd: S, ids: &[u32], work: &mut Work) {
        let drawn = self.storage.shown.as_deref().unwrap_or(self.storage.params);
        work.packet.gather(&self.fixed, drawn, self.view.keyframes, ids, self.first_id);
        for first in (0..PACKET).step_by(S::F32_LANES) {
            let lanes = work.packet.lanes(simd, first);
            let gradient = work.gradient(simd, first, &lanes, self);
            for i in 0..N_PARAMS {
                work.param_grads[i].store(first, gradient[i]);
            }
        }
        self.spare_finished(ids, work);
        self.sums.anisotropy += work.anisotropy.0[..ids.len()].iter().map(|&v| f64::from(v)).sum::<f64>();
        if self.rule.pose_gradient {
            self.add_pose_gradients(ids, work);
        }
        if let Some(shown) = &mut self.storage.shown {
            for (lane, &id) in ids.iter().enumerate() {
                shown[id as usize - self.first_id] = core::array::from_fn(|i| work.param_grads[i].0[lane]);
            }
            work.packet.gather_params(self.storage.params, ids, self.first_id);
        }
        if let Some(collected) = &mut self.storage.collected {
            for (lane, &id) in ids.iter().enumerate() {
                collected[id as usize - self.first_id] = core::array::from_fn(|i| work.param_grads[i].0[lane]);
            }
            return;
        }
        if self.rule.is_frozen() {
            return;
        }
        self.gather_moments(ids, work);
        for first in (0..PACKET).step_by(S::F32_LANES) {
            work.step(simd, first, self.rule);
        }
        self.scatter(ids, work);
    }

    fn add_pose_gradients(&mut self, ids: &[u32], work: &Work) {
        for (lane, &id) in ids.iter().enumerate() {
            let mut grad: [f64; 6] = core::array::from_fn(|i| f64::from(work.pose_grads[i].0[lane]));
            let header = &self.fixed.headers[id as usize / self.fixed.k];
            let fade = fade_of(header, &self.view.keyframes[header.keyframe_row as usize]);
            // dL/d(ln opacity) = -(sum dL/dq), because alpha = opacity exp(-q).
            let by_log_opacity = -work.splat_grads[0].0[lane];
            for i in 0..3 {
                grad[3 + i] += f64::from(by_log_opacity * fade[i]);
            }
            self.sums.pose.add(grad);
        }
    }

    fn gather_moments(&mut self, ids: &[u32], work: &mut Work) {
        for (lane, &id) in ids.iter().enumerate() {
            let at = id as usize - self.first_id;
            let moments = &self.storage.moments[at];
            for i in 0..N_PARAMS {
                work.first[i].0[lane] = moments.first[i];
                work.second[i].0[lane] = moments.second[i];
            }
            let steps = self.storage.steps[at].saturating_add(1);
            self.storage.steps[at] = steps;
            work.steps.0[lane] = f32::from(steps);
        }
    }

    fn scatter(&mut self, ids: &[u32], work: &Work) {
        for (lane, &id) in ids.iter().enumerate() {
            let at = id as usize - self.first_id;
            let (params, moments) = (&mut self.storage.params[at], &mut self.storage.moments[at]);
            *params = core::array::from_fn(|i| work.packet.params[i].0[lane]);
            moments.first = core::array::from_fn(|i| work.first[i].0[lane]);
            moments.second = core::array::from_fn(|i| work.second[i].0[lane]);
        }
    }
}

/// Numbers of one packet on their way.
struct Work {
    packet: Packet,
    splat_grads: [Row; N_SPLAT_GRADS],
    param_grads: [Row; N_PARAMS],
    pose_grads: [Row; 6],
    first: [Row; N_PARAMS],
    second: [Row; N_PARAMS],
    steps: Row,
    anisotropy: Row,
}

impl Work {
    fn new() -> Self {
        Self {
            packet: Packet::new(),
            splat_grads: [ZERO_ROW; N_SPLAT_GRADS],
            param_grads: [ZERO_ROW; N_PARAMS],
            pose_grads: [ZERO_ROW; 6],
            first: [ZERO_ROW; N_PARAMS],
            second: [ZERO_ROW; N_PARAMS],
            steps: Row([1.0; PACKET]),
            anisotropy: ZERO_ROW,
        }
    }

    #[inline(always)]
    fn set_splat_gradient(&mut self, lane: usize, grads: &[f32; N_SPLAT_GRADS]) {
        for (row, &value) in self.splat_grads.iter_mut().zip(grads) {
            row.0[lane] = value;
        }
    }

    #[inline(always)]
    fn gradient<S: Simd>(
        &mut self,
        simd: S,
        first: usize,
        lanes: &PacketLanes<S>,
        job: &UpdateJob<'_>,
    ) -> [Wide<S>; N_PARAMS] {
        let decoded = decode(&lanes.anchor, &lanes.params);
        let projected = project(&job.view.camera, &lanes.placement, &decoded);
        let mut sums = [Wide::splat(simd, 0.0); N_SPLAT_GRADS];
        for i in 0..N_SPLAT_GRADS {
            sums[i] = self.splat_grads[i].load(simd, first);
        }
        let splat = from_moments(&sums, &decoded, &projected);
        let grad = project_backward(&job.view.camera, &lanes.placement, &decoded, &projected, &splat);
        if job.rule.pose_gradient {
            let pose = grad.pose(&projected);
            for i in 0..6 {
                self.pose_grads[i].store(first, pose[i]);
            }
        }
        let mut out = decode_backward(&lanes.anchor, &lanes.params, &decoded, &grad.gaussian);
        let log_scale = each!(i in 3 => lanes.params[group::LOG_SCALE + i]);
        let (anisotropy, isotropy_grad) = anisotropy(&log_scale);
        self.anisotropy.store(first, anisotropy);
        let weight = Wide::splat(simd, job.rule.isotropy_weight);
        for i in 0..3 {
            out[group::LOG_SCALE + i] = weight.mul_add(isotropy_grad[i], out[group::LOG_SCALE + i]);
        }
        out
    }

    #[inline(always)]
    fn step<S: Simd>(&mut self, simd: S, first: usize, rule: &UpdateRule) {
        let correction = BiasCorrection::at(self.steps.load(simd, first));
        for i in 0..N_PARAMS {
            let [value, mean, square] = adam(
                self.packet.params[i].load(simd, first),
                self.first[i].load(simd, first),
                self.second[i].load(simd, first),
                self.param_grads[i].load(simd, first),
                Wide::splat(simd, rule.rates[i]),
                &correction,
            );
            self.packet.params[i].store(first, value);
            self.first[i].store(first, mean);
            self.second[i].store(first, square);
        }
    }
}

/// Gradients of a splat from the moments of `dL/dq` over its pixels.
///
/// With `d = pixel - mean`: `dq/dmean = -conic d`, `dq/dconic = [dx^2 / 2, dx dy, dy^2 / 2]`, and
/// `dL/dopacity = -(sum dL/dq) / opacity` because `alpha = opacity exp(-q)`.
#[inline(always)]
fn from_moments<L: Lane>(
    sums: &[L; N_SPLAT_GRADS],
    decoded: &Decoded<L>,
    projected: &Projected<L>,
) -> SplatGradient<L> {
    let [total, by_x, by_y, by_xx, by_xy, by_yy, ..] = *sums;
    let [xx, xy, yy] = projected.conic;
    let half = total.constant(0.5);
    SplatGradient {
        mean_px: [-(xx * by_x + xy * by_y), -(xy * by_x + yy * by_y)],
        conic: [half * by_xx, by_xy, half * by_yy],
        opacity: -total / decoded.opacity,
        color: each!(i in 3 => sums[GRAD_COLOR + i]),
        depth: sums[GRAD_DEPTH],
    }
}

/// `|s - mean(s)|_1` of the scales in units of the anchor's extent, and its gradient with respect to `log_scale`.
#[inline(always)]
pub fn anisotropy<L: Lane>(log_scale: &[L; 3]) -> (L, [L; 3]) {
    let scale = each!(i in 3 => log_scale[i].exp());
    let third = scale[0].constant(1.0 / 3.0);
    let mean = (scale[0] + scale[1] + scale[2]) * third;
    let sign = each!(i in 3 => (scale[i] - mean).signum());
    let mean_sign = (sign[0] + sign[1] + sign[2]) * third;
    let value = (scale[0] - mean).abs() + (scale[1] - mean).abs() + (scale[2] - mean).abs();
    (value, each!(i in 3 => (sign[i] - mean_sign) * scale[i]))
}
