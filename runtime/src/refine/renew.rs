//! The lifecycle of a stretch that is being trained: scores its anchors, ends some, and gives others another Gaussian.

use super::lifecycle::Tally;
use super::settings::LifecycleSettings;
use super::stretch::{READ_ANCHORS, StretchMemory};
use crate::mapping::{PruneLimits, keep_those, without_residual};
use crate::splat::{AnchorHeader, AnchorScore, GaussianParams, ScoreReport, TrainingView};
use kilogs_core::map::anchor::GAUSSIAN_PARAMS;
use kilogs_core::map::decoder::with_residual;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use std::collections::BTreeSet;

/// What came of it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct RenewCounts {
    /// Anchors that ended by their score.
    pub guilty: u64,
    /// Anchors that ended because all their Gaussians were faint or oversized.
    pub faint: u64,
    /// Anchors that ended because the route has enough.
    pub least_seen: u64,
    /// Anchors that got another Gaussian.
    pub densified: u64,
}

impl std::ops::AddAssign for RenewCounts {
    fn add_assign(&mut self, more: Self) {
        self.guilty += more.guilty;
        self.faint += more.faint;
        self.least_seen += more.least_seen;
        self.densified += more.densified;
    }
}

/// Scores of a stretch's views, collected one view after the other.
pub(super) struct Renewal {
    tally: Tally,
    scores: Vec<AnchorScore>,
}

impl Renewal {
    pub(super) fn new(memory: &mut StretchMemory<'_>) -> Self {
        let n_slots = memory.backend().capacities().anchors;
        Self { tally: Tally::new(n_slots), scores: vec![AnchorScore::default(); n_slots] }
    }

    pub(super) fn score(
        &mut self,
        memory: &mut StretchMemory<'_>,
        view: &TrainingView<'_>,
        settings: &LifecycleSettings,
    ) -> ScoreReport {
        let report = memory.backend().score_view(view, settings.error_threshold, &mut self.scores);
        if !report.stats.refused {
            self.tally.add(&self.scores, (report.loss.total, view.view.camera.width), settings.score);
        }
        report
    }

    /// Ends and densifies anchors of the pages whose keyframes begin in `keyframe_ids`.
    pub(super) fn apply(
        &self,
        memory: &mut StretchMemory<'_>,
        (keyframe_ids, most_gaussians): (std::ops::RangeInclusive<u32>, u64),
        (settings, limits): (&LifecycleSettings, &PruneLimits),
    ) -> RenewCounts {
        let mut counts = RenewCounts::default();
        let own = memory.own_slots(&keyframe_ids);
        let mut ended: BTreeSet<u32> = self.tally.guilty(&own, settings).into_iter().collect();
        counts.guilty = ended.len() as u64;
        let mut left = Vec::with_capacity(own.len());
        let mut renewed = Renewed { tally: &self.tally, settings, limits, counts: &mut counts };
        for slots in own.chunks(READ_ANCHORS) {
            renewed.renew(memory, slots, &mut ended, &mut left);
        }
        let least_seen = self.tally.least_seen(&left, most_gaussians);
        counts.least_seen = least_seen.len() as u64;
        ended.extend(least_seen);
        memory.retire(&ended);
        counts
    }
}

/// One pass over a stretch's anchors.
struct Renewed<'a> {
    tally: &'a Tally,
    settings: &'a LifecycleSettings,
    limits: &'a PruneLimits,
    counts: &'a mut RenewCounts,
}

impl Renewed<'_> {
    /// Drops faint and oversized Gaussians of some anchors and splits others; what stays is added to `left`.
    fn renew(
        &mut self,
        memory: &mut StretchMemory<'_>,
        slots: &[u32],
        ended: &mut BTreeSet<u32>,
        left: &mut Vec<(u32, u32)>,
    ) {
        let k = memory.backend().capacities().gaussians_per_anchor;
        let mut staged = memory.read(slots);
        for (nth, slot) in slots.iter().enumerate() {
            if ended.contains(slot) {
                continue;
            }
            let residual = memory.residual_at_spawn(&staged.headers[nth], &staged.features[nth]).to_vec();
            let (header, gaussians) = (&mut staged.headers[nth], &mut staged.params[nth * k..(nth + 1) * k]);
            let before = header.n_gaussians;
            if keep_those(header, gaussians, &residual, |header, shown| self.limits.keep(header, shown)) == 0 {
                ended.insert(*slot);
                self.counts.faint += 1;
                continue;
            }
            let splits = self.tally.needs_more(*slot, self.settings) && usize::from(header.n_gaussians) < k;
            if splits {
                split(header, gaussians, &residual);
                self.counts.densified += 1;
            }
            left.push((*slot, u32::from(header.n_gaussians)));
            if splits || header.n_gaussians != before {
                memory.backend().write_anchors(&[*slot], &[*header], gaussians);
                memory.backend().write_features(&[*slot], &[staged.features[nth]]);
            }
        }
    }
}

/// Standard deviations of the halves relative to the whole, along the axis that is cut (Kerbl et al. 2023, sec. 5.2).
const SPLIT_RATIO: f32 = 1.0 / 1.6;
/// How far the halves are from the middle, in standard deviations of the whole.
const SPLIT_SIGMAS: f32 = 0.7;

/// Cuts the largest Gaussian of an anchor with room for another one in two, along its longest axis.
fn split(header: &mut AnchorHeader, gaussians: &mut [GaussianParams], residual: &[f32]) {
    let residual_of = |nth: usize| residual.get(nth * GAUSSIAN_PARAMS..(nth + 1) * GAUSSIAN_PARAMS).unwrap_or_default();
    let n = usize::from(header.n_gaussians);
    let shown = |nth: usize, gaussians: &[GaussianParams]| with_residual(&gaussians[nth], residual_of(nth));
    let log_size = |gaussian: &GaussianParams| {
        (0..3).map(|axis| header.log_extent[axis] + gaussian.log_scale[axis]).fold(f32::NEG_INFINITY, f32::max)
    };
    let largest = (0..n).max_by(|&a, &b| log_size(&shown(a, gaussians)).total_cmp(&log_size(&shown(b, gaussians))));
    let Some(largest) = largest else { return };
    let whole = shown(largest, gaussians);
    let log_sigma = |axis: usize| header.log_extent[axis] + whole.log_scale[axis];
    let axis = (1..3).fold(0, |longest, axis| if log_sigma(axis) > log_sigma(longest) { axis } else { longest });
    let [x, y, z, w] = whole.quaternion_xyzw;
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let step_m = rotation * Vector3::ith(axis, SPLIT_SIGMAS * log_sigma(axis).exp());
    for (place, side) in [(largest, -1.0), (n, 1.0)] {
        let mut half = whole;
        for i in 0..3 {
            half.offset[i] += side * step_m[i] / header.log_extent[i].exp();
        }
        half.log_scale[axis] += SPLIT_RATIO.ln();
        gaussians[place] = without_residual(&half, residual_of(place));
    }
    header.n_gaussians += 1;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::{NO_GAUSSIAN, NO_HEADER};

    /// Offsets and scales along x of the Gaussians after a split.
    fn check(gaussians: &[GaussianParams], residual: &[f32], expected: &[(f32, f32)]) {
        let mut header =
            AnchorHeader { log_extent: [2.0_f32.ln(); 3], n_gaussians: gaussians.len() as u8, ..NO_HEADER };
        let mut params = gaussians.to_vec();
        params.push(NO_GAUSSIAN);
        split(&mut header, &mut params, residual);
        assert_eq!(usize::from(header.n_gaussians), expected.len());
        for (nth, (offset, log_scale)) in expected.iter().enumerate() {
            let residual = residual.get(nth * GAUSSIAN_PARAMS..(nth + 1) * GAUSSIAN_PARAMS).unwrap_or_default();
            let shown = with_residual(&params[nth], residual);
            let close = (shown.offset[0] - offset).abs() < 1e-5 && (shown.log_scale[0] - log_scale).abs() < 1e-5;
            assert!(close, "{nth}: {shown:?} instead of {offset}, {log_scale}");
        }
    }

    #[test]
    fn the_largest_gaussian_is_cut_along_its_longest_axis() {
        let round = GaussianParams { log_scale: [-3.0; 3], ..NO_GAUSSIAN };
        let long = GaussianParams { log_scale: [0.0, -2.0, -2.0], offset: [1.0, 0.0, 0.0], ..NO_GAUSSIAN };
        let (near, far, half) = (1.0 - 0.7, 1.0 + 0.7, -(1.6_f32.ln()));
        check(&[long], &[], &[(near, half), (far, half)]);
        check(&[round, long], &[], &[(0.0, -3.0), (near, half), (far, half)]);
        // What a decoder adds to the second place is taken off, so that it shows what the first showed.
        let mut residual = [0.0; 2 * GAUSSIAN_PARAMS];
        residual[GAUSSIAN_PARAMS] = 5.0;
        check(&[long], &residual, &[(near, half), (far, half)]);
        // Turned by a quarter about z, the long axis is y.
        let turned = GaussianParams { quaternion_xyzw: [0.0, 0.0, 1.0, 1.0], ..long };
        check(&[turned], &[], &[(1.0, half), (1.0, half)]);
    }
}
