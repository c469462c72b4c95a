//! Working memory of one insertion.

use kilogs_core::map::decoder::NO_FEATURE;
use kilogs_core::map::insertion::{InsertionSample, MapImageSize};
use kilogs_core::map::{AnchorFeature, AnchorHeader, GaussianParams};

/// Images at mapping resolution that an insertion compares, one value per pixel each.
#[derive(Debug)]
pub struct ImageScratch {
    /// Their size.
    pub size: MapImageSize,
    /// Rendered color.
    pub rgb: Box<[[f32; 3]]>,
    /// Rendered depth, then its inverse.
    pub rendered_depth: Box<[f32]>,
    /// Rendered transmittance.
    pub transmittance: Box<[f32]>,
    /// Brightness of the camera or of the rendered image, in [0, 1].
    pub luma: Box<[f32]>,
    /// Difference of brightness between the two.
    pub error: Box<[f32]>,
    /// First pass of a blur.
    pub blur: Box<[f32]>,
    /// Structure of the camera image.
    pub structure: Box<[f32]>,
    /// Structure of the rendered image.
    pub rendered_structure: Box<[f32]>,
    /// Edges of the depth source.
    pub depth_edges: Box<[f32]>,
    /// Edges of the rendered depth.
    pub rendered_depth_edges: Box<[f32]>,
    /// Inverse depth from the depth source, 1/m.
    pub inverse_depth: Box<[f32]>,
    /// How sure that is.
    pub confidence: Box<[f32]>,
    /// Probability of insertion.
    pub probability: Box<[f32]>,
    /// Local maxima.
    pub kept: Box<[u8]>,
    /// Pixels that get a Gaussian.
    pub samples: Box<[InsertionSample]>,
}

impl ImageScratch {
    /// Memory for images of a size, with at most `max_samples` insertions at once.
    pub fn new(size: MapImageSize, max_samples: usize) -> Self {
        let plane = || vec![0.0f32; size.n_pixels()].into_boxed_slice();
        Self {
            size,
            rgb: vec![[0.0; 3]; size.n_pixels()].into(),
            rendered_depth: plane(),
            transmittance: plane(),
            luma: plane(),
            error: plane(),
            blur: plane(),
            structure: plane(),
            rendered_structure: plane(),
            depth_edges: plane(),
            rendered_depth_edges: plane(),
            inverse_depth: plane(),
            confidence: plane(),
            probability: plane(),
            kept: vec![0; size.n_pixels()].into(),
            samples: vec![InsertionSample::default(); max_samples].into(),
        }
    }
}

/// Anchors on their way into or out of the backend.
#[derive(Debug)]
pub struct Staging {
    /// Slots, in order of arrival.
    pub slots: Vec<u32>,
    /// One per slot.
    pub headers: Vec<AnchorHeader>,
    /// `gaussians_per_anchor` per slot.
    pub params: Vec<GaussianParams>,
    /// One per slot.
    pub features: Vec<AnchorFeature>,
    /// Position in `slots` of a slot that is staged.
    stage_of_slot: Box<[u32]>,
    gaussians_per_anchor: usize,
    capacity: usize,
    peak: usize,
}

const NOT_STAGED: u32 = u32::MAX;

/// A Gaussian that is not there.
pub const NO_GAUSSIAN: GaussianParams = GaussianParams {
    offset: [0.0; 3],
    log_scale: [0.0; 3],
    quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
    opacity_logit: 0.0,
    color_logit: [0.0; 3],
};

/// A header of nothing; what a backend overwrites when it is read.
pub const NO_HEADER: AnchorHeader = AnchorHeader {
    position_in_keyframe_m: [0.0; 3],
    keyframe_row: 0,
    log_extent: [0.0; 3],
    level: 0,
    n_gaussians: 0,
    chunk_row: 0,
};

impl Staging {
    /// Room for `capacity` of the `anchors` slots at once.
    pub fn new(capacity: usize, anchors: usize, gaussians_per_anchor: usize) -> Self {
        Self {
            slots: Vec::with_capacity(capacity),
            headers: Vec::with_capacity(capacity),
            params: Vec::with_capacity(capacity * gaussians_per_anchor),
            features: Vec::with_capacity(capacity),
            stage_of_slot: vec![NOT_STAGED; anchors].into(),
            gaussians_per_anchor,
            capacity,
            peak: 0,
        }
    }

    /// Most anchors that were ever staged at once.
    pub fn peak(&self) -> usize {
        self.peak
    }

    /// Whether no further anchor fits.
    pub fn is_full(&self) -> bool {
        self.slots.len() >= self.capacity
    }

    /// Forgets what is staged.
    pub fn clear(&mut self) {
        for &slot in &self.slots {
            self.stage_of_slot[slot as usize] = NOT_STAGED;
        }
        self.slots.clear();
        self.headers.clear();
        self.params.clear();
        self.features.clear();
    }

    /// Stages a slot with a header and room for its Gaussians; the caller checked [`is_full`](Self::is_full).
    pub fn push(&mut self, slot: u32, header: AnchorHeader) {
        debug_assert!(!self.is_full());
        self.stage_of_slot[slot as usize] = self.slots.len() as u32;
        self.slots.push(slot);
        self.headers.push(header);
        self.features.push(NO_FEATURE);
        self.params.extend(std::iter::repeat_n(NO_GAUSSIAN, self.gaussians_per_anchor));
        self.peak = self.peak.max(self.slots.len());
    }

    /// Stages a slot with everything that it holds, of `gaussians` what it uses.
    pub fn push_whole(
        &mut self,
        slot: u32,
        header: AnchorHeader,
        feature: &AnchorFeature,
        gaussians: &[GaussianParams],
    ) {
        let nth = self.slots.len();
        self.push(slot, header);
        self.features[nth] = *feature;
        let places = &mut self.params[nth * self.gaussians_per_anchor..];
        let used = gaussians.iter().take(usize::from(header.n_gaussians));
        places.iter_mut().zip(used).for_each(|(place, gaussian)| *place = *gaussian);
    }

    /// Adds a Gaussian to a staged slot; false when the slot is not staged or has as many as it can hold.
    pub fn add_gaussian(&mut self, slot: u32, gaussian: GaussianParams) -> bool {
        let stage = self.stage_of_slot[slot as usize];
        let Some(header) = self.headers.get_mut(stage as usize) else { return false };
        let nth = usize::from(header.n_gaussians);
        if nth >= self.gaussians_per_anchor {
            return false;
        }
        self.params[stage as usize * self.gaussians_per_anchor + nth] = gaussian;
        header.n_gaussians += 1;
        true
    }

    /// Exchanges the contents of two places; [`add_gaussian`](Self::add_gaussian) must not follow.
    pub fn swap(&mut self, a: usize, b: usize) {
        self.slots.swap(a, b);
        self.headers.swap(a, b);
        self.features.swap(a, b);
        for i in 0..self.gaussians_per_anchor {
            self.params.swap(a * self.gaussians_per_anchor + i, b * self.gaussians_per_anchor + i);
        }
    }

    /// Whether a slot is staged.
    pub fn holds(&self, slot: u32) -> bool {
        self.stage_of_slot[slot as usize] != NOT_STAGED
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_staged_anchor_takes_as_many_gaussians_as_it_has_room_for() {
        let mut staging = Staging::new(2, 10, 2);
        staging.push(7, NO_HEADER);
        assert!(staging.add_gaussian(7, NO_GAUSSIAN) && staging.add_gaussian(7, NO_GAUSSIAN));
        assert!(!staging.add_gaussian(7, NO_GAUSSIAN), "full");
        assert!(!staging.add_gaussian(3, NO_GAUSSIAN), "not staged");
        staging.push(3, NO_HEADER);
        assert!(staging.is_full() && staging.holds(3));
        assert_eq!((staging.headers[0].n_gaussians, staging.params.len()), (2, 4));
        staging.clear();
        assert!(!staging.holds(7) && !staging.add_gaussian(7, NO_GAUSSIAN));
        staging.push(3, NO_HEADER);
        assert_eq!(staging.peak(), 2);
    }
}
