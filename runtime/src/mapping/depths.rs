//! Depth of the newest keyframes to train on: a ring of fixed size, oldest overwritten.

use crate::splat::DepthTarget;

/// Depths that motion stereo found, each with its confidence, at mapping resolution.
#[derive(Debug)]
pub struct KeyframeDepths {
    n_pixels: usize,
    ordinals: Box<[Option<u32>]>,
    depth_m: Box<[f32]>,
    confidence: Box<[f32]>,
    n_kept: usize,
}

impl KeyframeDepths {
    /// Room for `capacity` keyframes of `n_pixels` each; with none, nothing is kept.
    pub fn new(n_pixels: usize, capacity: usize) -> Self {
        Self {
            n_pixels,
            ordinals: vec![None; capacity].into(),
            depth_m: vec![0.0; capacity * n_pixels].into(),
            confidence: vec![0.0; capacity * n_pixels].into(),
            n_kept: 0,
        }
    }

    /// Keyframes whose depth is kept.
    pub fn len(&self) -> usize {
        self.n_kept.min(self.ordinals.len())
    }

    /// Keeps the depth of a keyframe in place of its earlier one, or of the oldest. The error of motion stereo grows with
    /// the square of the depth: beyond `trusted_m`, confidence falls as fast.
    pub fn keep(&mut self, ordinal: u32, inverse_depth: &[f32], confidence: &[f32], trusted_m: f32) {
        let Some(oldest) = self.n_kept.checked_rem(self.ordinals.len()) else { return };
        let known = self.ordinals.iter().position(|&known| known == Some(ordinal));
        self.n_kept += usize::from(known.is_none());
        let slot = known.unwrap_or(oldest);
        self.ordinals[slot] = Some(ordinal);
        let pixels = slot * self.n_pixels..(slot + 1) * self.n_pixels;
        let kept = self.depth_m[pixels.clone()].iter_mut().zip(&mut self.confidence[pixels]);
        for ((depth_m, sure), (&inverse, &confidence)) in kept.zip(inverse_depth.iter().zip(confidence)) {
            let is_known = inverse > 0.0 && confidence > 0.0;
            *depth_m = if is_known { 1.0 / inverse } else { 0.0 };
            *sure = if is_known { confidence * (trusted_m * inverse).powi(2).min(1.0) } else { 0.0 };
        }
    }

    /// The depth of a keyframe, while it is kept.
    pub fn of(&self, ordinal: u32) -> Option<DepthTarget<'_>> {
        let slot = self.ordinals.iter().position(|&known| known == Some(ordinal))?;
        let pixels = slot * self.n_pixels..(slot + 1) * self.n_pixels;
        Some(DepthTarget { depth_m: &self.depth_m[pixels.clone()], confidence: &self.confidence[pixels] })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Keeps depths of one pixel in a ring of two; depth and confidence of a keyframe.
    fn check(kept: &[(u32, f32)], ordinal: u32, expected: Option<(f32, f32)>) {
        let mut depths = KeyframeDepths::new(1, 2);
        for &(ordinal, inverse_depth) in kept {
            depths.keep(ordinal, &[inverse_depth], &[0.8], 10.0);
        }
        let found = depths.of(ordinal).map(|target| (target.depth_m[0], target.confidence[0]));
        assert_eq!(found, expected, "{kept:?}");
    }

    #[test]
    fn the_oldest_depth_leaves_first_and_a_known_keyframe_keeps_its_place() {
        check(&[(1, 0.5), (2, 0.25), (3, 0.125)], 1, None);
        check(&[(1, 0.5), (2, 0.25), (3, 0.125)], 2, Some((4.0, 0.8)));
        check(&[(1, 0.5), (2, 0.25), (1, 1.0), (1, 0.5)], 2, Some((4.0, 0.8)));
        check(&[(1, 0.5), (2, 0.25), (1, 1.0), (3, 0.5)], 1, None);
        assert!(KeyframeDepths::new(1, 0).of(0).is_none());
    }

    #[test]
    fn sky_is_no_depth_and_far_surfaces_count_less() {
        check(&[(1, 0.0)], 1, Some((0.0, 0.0)));
        check(&[(1, 0.05)], 1, Some((20.0, 0.2)));
    }
}
