//! What ends: Gaussians that are faint or oversized when their keyframe leaves the window.

use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use super::scratch::{NO_GAUSSIAN, Staging};
use super::settings::MapperSettings;
use crate::splat::{GaussianParams, KeyframePlacement};
use kilogs_core::camera::Pinhole;
use kilogs_core::map::AnchorHeader;
use kilogs_core::map::anchor::GAUSSIAN_PARAMS;
use kilogs_core::map::decoder::with_residual;

impl Mapper {
    /// Drops the faint and the oversized Gaussians of the keyframe that has just left the window.
    pub(super) fn prune_after_window(&mut self) {
        if let Some(left) = self.images.newest(self.settings.window).map(|kept| kept.keyframe.ordinal) {
            self.prune(left);
        }
    }

    /// Drops the faint and the oversized Gaussians of a keyframe.
    pub(super) fn prune(&mut self, ordinal: u32) {
        let limits = PruneLimits::of(&self.settings, self.images.camera());
        self.read_decoder(ordinal / CHUNK_KEYFRAMES);
        let mut next_slot = Some(0);
        while let Some(first_slot) = next_slot {
            next_slot = self.stage(first_slot, |record| record.keyframe_ordinal == ordinal);
            self.read_staged();
            self.prune_staged(|_, header, gaussian| limits.keep(header, gaussian));
            self.staging.clear();
        }
    }

    /// Drops the staged Gaussians that are not to be kept.
    pub(super) fn prune_staged(&mut self, keep: impl Fn(&KeyframePlacement, &AnchorHeader, &GaussianParams) -> bool) {
        let k = self.capacity.gaussians_per_anchor;
        // Anchors that lost all Gaussians go to the front, those that lost some behind them.
        let mut n_ended = 0;
        let mut n_changed = 0;
        for nth in 0..self.staging.slots.len() {
            let slot = self.staging.slots[nth];
            let placement = self.ordinal_in(slot).and_then(|ordinal| self.placement_of(ordinal)).copied();
            let Some(placement) = placement else { continue };
            let Staging { headers, params, features, .. } = &mut self.staging;
            let residual = self.decoders.residual_at_spawn(&headers[nth], &features[nth]);
            let before = headers[nth].n_gaussians;
            let gaussians = &mut params[nth * k..(nth + 1) * k];
            let keep = |header: &AnchorHeader, gaussian: &GaussianParams| keep(&placement, header, gaussian);
            let after = keep_those(&mut headers[nth], gaussians, residual, keep);
            self.quota.give_back(f64::from(before - after));
            if after == before && after > 0 {
                continue;
            }
            self.staging.swap(n_changed, nth);
            if after == 0 {
                self.staging.swap(n_ended, n_changed);
                n_ended += 1;
            }
            n_changed += 1;
        }
        let changed = n_ended..n_changed;
        let Staging { slots, headers, params, features, .. } = &self.staging;
        let params = &params[changed.start * k..changed.end * k];
        self.backend.write_anchors(&slots[changed.clone()], &headers[changed.clone()], params);
        self.backend.write_features(&slots[changed.clone()], &features[changed]);
        self.forget(0..n_ended);
        self.counters.anchors_pruned += n_ended as u64;
    }
}

/// A Gaussian is as wide as three standard deviations either way.
const WIDTH_IN_SIGMAS: f32 = 6.0;

/// What a Gaussian must keep to.
pub(crate) struct PruneLimits {
    min_opacity_logit: f32,
    /// Largest standard deviation over depth, seen from the keyframe that spawned it.
    max_sigma_z1: f32,
}

/// Largest standard deviation over depth that a Gaussian may have in a view.
pub(super) fn max_sigma_z1(settings: &MapperSettings, camera: &Pinhole) -> f32 {
    settings.max_width_ratio * camera.width as f32 / WIDTH_IN_SIGMAS / camera.fx as f32
}

impl PruneLimits {
    /// The limits of `settings` in pictures of `camera`.
    pub(crate) fn of(settings: &MapperSettings, camera: &Pinhole) -> Self {
        Self {
            min_opacity_logit: (settings.min_opacity / (1.0 - settings.min_opacity)).ln(),
            max_sigma_z1: max_sigma_z1(settings, camera),
        }
    }

    /// Whether a Gaussian, as it is shown, is neither faint nor oversized.
    pub(crate) fn keep(&self, header: &AnchorHeader, gaussian: &GaussianParams) -> bool {
        let depth_m = center_in_keyframe_m(header, gaussian)[2];
        let is_wide = largest_sigma_m(header, gaussian) > self.max_sigma_z1 * depth_m.abs();
        gaussian.opacity_logit >= self.min_opacity_logit && !is_wide
    }
}

/// Centre of a Gaussian in the frame of the keyframe that spawned it, m.
pub(super) fn center_in_keyframe_m(header: &AnchorHeader, gaussian: &GaussianParams) -> [f32; 3] {
    [0, 1, 2].map(|i| header.position_in_keyframe_m[i] + gaussian.offset[i] * header.log_extent[i].exp())
}

/// Largest standard deviation of a Gaussian, m of the keyframe that spawned it.
pub(super) fn largest_sigma_m(header: &AnchorHeader, gaussian: &GaussianParams) -> f32 {
    (0..3).map(|i| (header.log_extent[i] + gaussian.log_scale[i]).exp()).fold(0.0, f32::max)
}

/// Moves the Gaussians to keep to the front; how many there are. One that moves looks as before from the keyframe
/// that spawned it: what the decoder adds at its new place instead of the old one is taken off.
pub(crate) fn keep_those(
    header: &mut AnchorHeader,
    gaussians: &mut [GaussianParams],
    residual: &[f32],
    keep: impl Fn(&AnchorHeader, &GaussianParams) -> bool,
) -> u8 {
    let residual_of = |nth: usize| residual.get(nth * GAUSSIAN_PARAMS..(nth + 1) * GAUSSIAN_PARAMS).unwrap_or_default();
    let mut kept = 0;
    for nth in 0..usize::from(header.n_gaussians) {
        let shown = with_residual(&gaussians[nth], residual_of(nth));
        if keep(header, &shown) {
            if kept != nth {
                gaussians[kept] = without_residual(&shown, residual_of(kept));
            }
            kept += 1;
        }
    }
    gaussians[kept..].fill(NO_GAUSSIAN);
    header.n_gaussians = kept as u8;
    kept as u8
}

/// The Gaussian that looks like `shown` once the decoder has added `residual`.
pub(crate) fn without_residual(shown: &GaussianParams, residual: &[f32]) -> GaussianParams {
    let mut negative = [0.0; GAUSSIAN_PARAMS];
    negative.iter_mut().zip(residual).for_each(|(negative, residual)| *negative = -residual);
    with_residual(shown, &negative)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mapping::scratch::NO_HEADER;

    const LIMITS: PruneLimits = PruneLimits { min_opacity_logit: -1.0, max_sigma_z1: 1.0 };
    const HEADER: AnchorHeader = AnchorHeader { position_in_keyframe_m: [0.0, 0.0, 10.0], n_gaussians: 3, ..NO_HEADER };

    fn gaussian(opacity_logit: f32, log_scale: f32) -> GaussianParams {
        GaussianParams { opacity_logit, log_scale: [log_scale; 3], ..NO_GAUSSIAN }
    }

    fn check(gaussians: [GaussianParams; 3], residual: &[f32], expected: &[GaussianParams]) {
        let (mut header, mut kept) = (HEADER, gaussians);
        let n = keep_those(&mut header, &mut kept, residual, |header, shown| LIMITS.keep(header, shown));
        assert_eq!((usize::from(n), usize::from(header.n_gaussians)), (expected.len(), expected.len()));
        assert_eq!(&kept[..expected.len()], expected, "{gaussians:?}");
        assert!(kept[expected.len()..].iter().all(|gaussian| *gaussian == NO_GAUSSIAN));
    }

    #[test]
    fn the_faint_and_the_oversized_end_and_the_others_move_up() {
        let [faint, wide, good] = [gaussian(-2.0, 0.0), gaussian(0.0, 3.0), gaussian(0.5, 1.0)];
        check([good, good, good], &[], &[good; 3]);
        check([faint, good, wide], &[], &[good]);
        check([faint, wide, faint], &[], &[]);
    }

    #[test]
    fn what_is_shown_decides_and_a_gaussian_that_moves_looks_as_before() {
        let good = gaussian(0.5, 1.0);
        // The decoder makes the first faint, and adds half to the last one's opacity, which is to be the first.
        let mut residual = [0.0; 3 * GAUSSIAN_PARAMS];
        residual[10] = -2.0;
        residual[2 * GAUSSIAN_PARAMS + 10] = 0.5;
        let moved = gaussian(0.5 + 0.5 + 2.0, 1.0);
        check([good, gaussian(-2.0, 0.0), good], &residual, &[moved]);
    }
}
