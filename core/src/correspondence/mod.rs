//! Matches between two images that do not come from tracks: found by descriptors, densely, or by a trained network.
//!
//! Tracks are exact and cheap, and break when the light, the exposure or the distance between two images changes too
//! much. What stands here starts from the two images alone.

pub mod dense;
pub mod sparse;
mod local_flow;
mod window_search;

#[cfg(test)]
mod testing;

pub use dense::{DenseCapacities, DenseMatcher, DenseNode, DenseSettings, DenseStorage};
pub use sparse::{DescriptorMatcher, DescriptorMatcherSettings, DescriptorStorage};
pub use window_search::WindowSettings;

use crate::frame::Pyramid;

/// The two images of a matching.
#[derive(Clone, Copy, Debug)]
pub struct ImagePair<'a> {
    /// The last keyframe.
    pub keyframe: &'a Pyramid<'a>,
    /// Its ordinal: what was found in it may be kept until another keyframe comes.
    pub keyframe_ordinal: u32,
    /// The current frame.
    pub current: &'a Pyramid<'a>,
}

/// One scene point in both images. Pixel centres lie at +0.5.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PixelMatch {
    /// In the keyframe, px.
    pub keyframe_px: [f32; 2],
    /// In the current frame, px.
    pub current_px: [f32; 2],
    /// From 0, a guess, to 1, certain; comparable within one matcher only.
    pub confidence: f32,
}

/// Finds matches between two images.
///
/// Implementations take no memory from the heap of the calling thread, and find the same matches in the same images.
pub trait PairMatcher {
    /// Fills `matches` from the front and returns how many there are; a full slice keeps the most confident ones.
    fn match_pair(&mut self, pair: &ImagePair<'_>, matches: &mut [PixelMatch]) -> usize;
}

/// Knows the metric depth of an image.
///
/// The same conditions as for a [`PairMatcher`].
pub trait DepthPrior {
    /// Fills `depths_m` (along the optical axis; as long as `pixels`; NaN where unknown) and returns how many are
    /// known.
    fn depths_m(&mut self, image: &Pyramid<'_>, pixels: &[[f32; 2]], depths_m: &mut [f32]) -> usize;
}
