//! What the host remembers of a map that lives on a device.

use crate::splat::{
    AnchorFeature, AnchorHeader, BACKGROUND_TEXELS, Capacities, DecoderShape, Exposure, GaussianParams,
    KeyframePlacement, MemoryRow, SplatBackend,
};

/// Everything that was written to a backend or read from it, in its newest version.
///
/// Training changes numbers on the device that the host only sees when it reads them: when a keyframe leaves the window
/// and when a page leaves memory. A map that is rebuilt from here has its anchors as they were then, or as they were
/// spawned.
pub struct HostCopy {
    gaussians_per_anchor: usize,
    decoder_len: usize,
    headers: Vec<AnchorHeader>,
    params: Vec<GaussianParams>,
    features: Vec<AnchorFeature>,
    placements: Vec<KeyframePlacement>,
    backgrounds: Vec<[f32; 3]>,
    has_background: Vec<bool>,
    decoders: Vec<f32>,
    has_decoder: Vec<bool>,
    exposures: Vec<Exposure>,
}

const NO_ANCHOR: AnchorHeader = AnchorHeader {
    position_in_keyframe_m: [0.0; 3],
    keyframe_row: 0,
    log_extent: [0.0; 3],
    level: 0,
    n_gaussians: 0,
    chunk_row: 0,
};

const NO_GAUSSIAN: GaussianParams = GaussianParams {
    offset: [0.0; 3],
    log_scale: [0.0; 3],
    quaternion_xyzw: [0.0; 4],
    opacity_logit: 0.0,
    color_logit: [0.0; 3],
};

impl HostCopy {
    /// A copy of an empty map.
    pub fn new(capacities: &Capacities) -> Self {
        let learned = |n: usize| if capacities.learned_decoder { n } else { 0 };
        let (anchors, k, rows) = (capacities.anchors, capacities.gaussians_per_anchor, capacities.chunk_rows);
        let decoder_len = DecoderShape::new(k).len();
        Self {
            gaussians_per_anchor: k,
            decoder_len,
            headers: vec![NO_ANCHOR; anchors],
            params: vec![NO_GAUSSIAN; anchors * k],
            features: vec![[0.0; _]; learned(anchors)],
            placements: vec![KeyframePlacement::identity(); capacities.keyframe_rows],
            backgrounds: vec![[0.0; 3]; rows * BACKGROUND_TEXELS],
            has_background: vec![false; rows],
            decoders: vec![0.0; learned(rows * decoder_len)],
            has_decoder: vec![false; learned(rows)],
            exposures: vec![Exposure::IDENTITY; capacities.exposure_slots],
        }
    }

    /// What it costs on the host, by the capacity that it grows with.
    pub fn memory_plan(capacities: &Capacities) -> [MemoryRow; 4] {
        let learned = |n: usize| if capacities.learned_decoder { n } else { 0 };
        let k = capacities.gaussians_per_anchor;
        let anchor = size_of::<AnchorHeader>() + k * size_of::<GaussianParams>() + learned(size_of::<AnchorFeature>());
        let decoder = learned(DecoderShape::new(k).len() * size_of::<f32>() + 1);
        let row = |name, elements, bytes_per_element| MemoryRow { name, elements, bytes_per_element };
        [
            row("splat.anchors", capacities.anchors, anchor),
            row("splat.keyframe_rows", capacities.keyframe_rows, size_of::<KeyframePlacement>()),
            row("splat.chunk_rows", capacities.chunk_rows, BACKGROUND_TEXELS * size_of::<[f32; 3]>() + 1 + decoder),
            row("splat.exposure_slots", capacities.exposure_slots, size_of::<Exposure>()),
        ]
    }

    /// Remembers anchors; slots beyond the capacity are the backend's to refuse.
    pub fn note_anchors(&mut self, slots: &[u32], headers: &[AnchorHeader], params: &[GaussianParams]) {
        let k = self.gaussians_per_anchor;
        for ((&slot, header), params) in slots.iter().zip(headers).zip(params.chunks_exact(k)) {
            let slot = slot as usize;
            if let (Some(kept), Some(kept_params)) =
                (self.headers.get_mut(slot), self.params.get_mut(slot * k..(slot + 1) * k))
            {
                *kept = *header;
                kept_params.copy_from_slice(params);
            }
        }
    }

    /// Remembers features; newly written anchors have none.
    pub fn note_features(&mut self, slots: &[u32], features: &[AnchorFeature]) {
        for (&slot, feature) in slots.iter().zip(features) {
            if let Some(kept) = self.features.get_mut(slot as usize) {
                *kept = *feature;
            }
        }
    }

    /// Forgets the features of anchors that were written anew.
    pub fn clear_features(&mut self, slots: &[u32]) {
        for &slot in slots {
            if let Some(kept) = self.features.get_mut(slot as usize) {
                *kept = [0.0; _];
            }
        }
    }

    /// Forgets anchors.
    pub fn retire(&mut self, slots: &[u32]) {
        for &slot in slots {
            if let Some(kept) = self.headers.get_mut(slot as usize) {
                *kept = NO_ANCHOR;
            }
        }
    }

    /// Remembers where keyframes are.
    pub fn note_keyframes(&mut self, first_row: u32, placements: &[KeyframePlacement]) {
        let rows = self.placements.get_mut(first_row as usize..).unwrap_or_default();
        rows.iter_mut().zip(placements).for_each(|(kept, placement)| *kept = *placement);
    }

    /// Remembers a background that the backend took or gave.
    pub fn note_background(&mut self, chunk_row: u16, texels: &[[f32; 3]]) {
        let row = usize::from(chunk_row);
        let kept = self.backgrounds.get_mut(row * BACKGROUND_TEXELS..(row + 1) * BACKGROUND_TEXELS);
        if let Some(kept) = kept.filter(|kept| kept.len() == texels.len()) {
            kept.copy_from_slice(texels);
            self.has_background[row] = true;
        }
    }

    /// Remembers a decoder that the backend took or gave.
    pub fn note_decoder(&mut self, chunk_row: u16, weights: &[f32]) {
        let (row, len) = (usize::from(chunk_row), self.decoder_len);
        if let Some(kept) = self.decoders.get_mut(row * len..(row + 1) * len).filter(|kept| kept.len() == weights.len())
        {
            kept.copy_from_slice(weights);
            self.has_decoder[row] = true;
        }
    }

    /// Remembers an exposure.
    pub fn note_exposure(&mut self, slot: u32, exposure: Exposure) {
        if let Some(kept) = self.exposures.get_mut(slot as usize) {
            *kept = exposure;
        }
    }

    /// Writes all of it into an empty backend of the same capacities; returns how many anchors there are.
    pub fn restore_into(&self, backend: &mut dyn SplatBackend) -> usize {
        backend.set_keyframes(0, &self.placements);
        let mut n_anchors = 0;
        for (slot, (header, params)) in
            (0_u32..).zip(self.headers.iter().zip(self.params.chunks(self.gaussians_per_anchor)))
        {
            if header.n_gaussians > 0 && backend.write_anchors(&[slot], &[*header], params) == 0 {
                n_anchors += 1;
                if let Some(feature) = self.features.get(slot as usize) {
                    backend.write_features(&[slot], &[*feature]);
                }
            }
        }
        for (row, texels) in (0..).zip(self.backgrounds.chunks(BACKGROUND_TEXELS)) {
            if self.has_background[usize::from(row)] {
                backend.write_background(row, texels);
            }
        }
        for (row, weights) in (0..).zip(self.decoders.chunks(self.decoder_len)) {
            if self.has_decoder[usize::from(row)] {
                backend.write_decoder(row, weights);
            }
        }
        for (slot, &exposure) in (0..).zip(&self.exposures) {
            backend.write_exposure(slot, exposure);
        }
        n_anchors
    }
}

/// The map as the host last saw it, for whoever reads between a loss and the next call that changes the map.
impl HostCopy {
    /// As [`SplatBackend::read_anchors`].
    pub fn read_anchors(&self, slots: &[u32], headers: &mut [AnchorHeader], params: &mut [GaussianParams]) -> usize {
        let k = self.gaussians_per_anchor;
        let mut n_missing = slots.len();
        for ((&slot, header), params) in slots.iter().zip(headers).zip(params.chunks_exact_mut(k)) {
            let slot = slot as usize;
            if let (Some(kept), Some(kept_params)) = (self.headers.get(slot), self.params.get(slot * k..(slot + 1) * k))
            {
                *header = *kept;
                params.copy_from_slice(kept_params);
                n_missing -= 1;
            }
        }
        n_missing
    }

    /// As [`SplatBackend::read_features`].
    pub fn read_features(&self, slots: &[u32], features: &mut [AnchorFeature]) -> usize {
        let mut n_missing = slots.len();
        for (&slot, feature) in slots.iter().zip(features) {
            if let Some(kept) = self.features.get(slot as usize) {
                *feature = *kept;
                n_missing -= 1;
            }
        }
        n_missing
    }

    /// As [`SplatBackend::read_background`].
    pub fn read_background(&self, chunk_row: u16, texels: &mut [[f32; 3]]) -> bool {
        let row = usize::from(chunk_row);
        let kept = self.backgrounds.get(row * BACKGROUND_TEXELS..(row + 1) * BACKGROUND_TEXELS);
        kept.filter(|kept| kept.len() == texels.len()).map(|kept| texels.copy_from_slice(kept)).is_some()
    }

    /// As [`SplatBackend::read_decoder`].
    pub fn read_decoder(&self, chunk_row: u16, weights: &mut [f32]) -> bool {
        let (row, len) = (usize::from(chunk_row), self.decoder_len);
        let kept = self.decoders.get(row * len..(row + 1) * len).filter(|kept| kept.len() == weights.len());
        kept.map(|kept| weights.copy_from_slice(kept)).is_some()
    }

    /// As [`SplatBackend::read_exposure`].
    pub fn read_exposure(&self, slot: u32) -> Option<Exposure> {
        self.exposures.get(slot as usize).copied()
    }
}
