//! What the lifecycle asks of a view: how much of it each anchor shows, and how much of that is wrong (method.md 12).

use super::{LossTerms, RenderStats};
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// How an anchor contributes to one view.
///
/// Counts are of contributions: pixels, counted once for each of the anchor's Gaussians that contributes there, so that
/// an anchor that shows `n` pixels has between `n` and `k n` of them. They are integers and do not depend on any order.
#[derive(Clone, Copy, Debug, Default, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct AnchorScore {
    /// Contributions of at least 1/255, which is one 8-bit step of the Gaussian's color.
    pub covered: u32,
    /// Those of them where the picture is wrong: the mean over the channels of the absolute difference, after exposure,
    /// is above the threshold.
    pub masked: u32,
    /// Largest half width or height, px, of the box around where one of its Gaussians has an alpha of 1/255; 0 when none
    /// meets the picture.
    pub radius_px: f32,
}

/// What a view says besides its anchors' scores.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ScoreReport {
    /// Terms of the loss that look at the picture; `total` is the view's photometric loss,
    /// [`LossWeights::PHOTOMETRIC`](super::LossWeights::PHOTOMETRIC).
    pub loss: LossTerms,
    /// Pixels where the picture is wrong.
    pub masked_pixels: u32,
    /// Size of the work; `refused` when the view or a slice did not fit, and nothing was written.
    pub stats: RenderStats,
}

impl ScoreReport {
    /// A view that does not fit.
    pub fn refused() -> Self {
        Self { stats: RenderStats { refused: true, ..RenderStats::default() }, ..Self::default() }
    }
}
