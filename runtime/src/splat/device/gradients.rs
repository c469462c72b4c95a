//! Gradients to look at, for tests and for the conformance of backends.

use super::backend::DeviceBackend;
use super::executor::Executor;
use crate::splat::View;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::layout::Counters;
use crate::splat::program::{Buffer, Part};
use zerocopy::IntoBytes;

impl<E: Executor> DeviceBackend<E> {
    /// Gradients of `sum(rgb * upstream_rgb) + sum(depth * upstream_depth) + sum(transmittance *
    /// upstream_transmittance)` with respect to every Gaussian's trained numbers (`slot * k + i`; 0 where nothing is
    /// visible) and to the background's texels, like those of the CPU backend. Trains nothing; allocates.
    ///
    /// The planes are red, green, blue, depth, transmittance. False when a length or the view does not fit, or the
    /// device fails.
    pub fn gradients(
        &mut self,
        view: &View,
        upstream: [&[f32]; 5],
        params: &mut [[f32; N_PARAMS]],
        texels: &mut [[f32; 3]],
    ) -> bool {
        let n_pixels = view.n_pixels();
        let fits = self.capacities.fits(view) && n_pixels <= self.capacities.training_pixels;
        let n_gaussians = self.capacities.anchors * self.capacities.gaussians_per_anchor;
        if !fits || upstream.iter().any(|p| p.len() != n_pixels) || params.len() != n_gaussians {
            return false;
        }
        let uploaded = upstream.iter().enumerate().all(|(i, plane)| {
            self.device.call(|e| e.upload(Buffer::Upstream, i * n_pixels * size_of::<f32>(), plane.as_bytes()))
        });
        let mut block = self.block(view);
        block.isotropy_weight = 0.0;
        uploaded && self.run(view, &block, &self.drawing_then(&[Part::Backward])) && self.read_gradients(params, texels)
    }

    /// Reads the gradients of the last backward pass.
    pub(super) fn read_gradients(&self, params: &mut [[f32; N_PARAMS]], texels: &mut [[f32; 3]]) -> bool {
        let capacity = self.capacities.visible_gaussians;
        let mut counters = Counters::default();
        let mut candidates = vec![0u32; capacity];
        let mut numbers = vec![0f32; capacity * N_PARAMS];
        let read = self.device.call(|e| {
            e.download(Buffer::Counters, 0, counters.as_mut_bytes())?;
            e.download(Buffer::Candidates, 0, candidates.as_mut_bytes())?;
            e.download(Buffer::Effective, 0, numbers.as_mut_bytes())?;
            e.download(Buffer::TexelGrads, 0, texels.as_mut_bytes())
        });
        params.fill([0.0; N_PARAMS]);
        for (c, &id) in candidates.iter().take(counters.candidates as usize).enumerate() {
            params[id as usize] = core::array::from_fn(|i| numbers[i * capacity + c]);
        }
        read
    }
}
