//! Matches all over the image without a prediction: slow, and for when tracks have broken.
//!
//! 1. [`volume`]: on the coarsest level every node of a grid is correlated with everything within reach, and takes over
//!    what its neighbours found nearby. Correlation does not see brightness and contrast; neighbours settle what noise
//!    and repetition leave open, and let the image be zoomed.
//! 2. [`field`]: each node takes the flow that most of its neighbours share, and the shape that follows from it.
//! 3. [`refine`]: level by level, windows deformed by that shape are shifted to where they fit best, there and back.
//!
//! On a warped picture of KITTI 04, the median error of a match is 0.05 to 0.1 px at any brightness and contrast, 0.35 to
//! 0.5 px with noise of 10 grey values on a quarter of the contrast, and 1 px with a blur of 25 px: 0.1, 0.4 and 0.9 px of
//! standard deviation in each direction.
//!
//! What is flat, contradicted by its neighbours, or does not come back is left out.

mod field;
mod refine;
mod storage;
mod volume;

pub use storage::{DenseCapacities, DenseStorage, DenseStorageTooSmall};

use super::{ImagePair, PairMatcher, PixelMatch, WindowSettings};
use crate::features::SimdLevel;
use crate::features::corners::REFERENCE_WIDTH_PX;
pub use field::DenseNode;
use storage::Grid;

/// Constants of the dense matcher.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DenseSettings {
    /// Noise of the coarsest level, grey values: what varies by less counts as flat. Range (0, 20]; ours.
    pub coarse_noise: f32,
    /// Rounds of taking over what neighbours found, each with neighbours twice as far away. Range 0..=3; ours.
    pub n_rounds: u32,
    /// Share of the neighbours that have to agree with a node. Range [0, 1]; ours.
    pub min_support: f32,
    /// Search of the windows; the correlation is that on half the resolution, where noise is low and detail still there.
    pub windows: WindowSettings,
    /// Standard deviation that a match may be expected to have, px. Range (0, 10]; ours.
    pub max_sigma_px: f32,
    /// How far a match may be from where its neighbours expect it, px. Range (0, 20]; ours.
    pub max_deviation_px: f32,
    /// The same, more per px of distance from the neighbour. Range [0, 1]; ours.
    pub max_deviation_per_px: f32,
    /// Confidence below which a match is left out. Range [0, 1]; ours: of warped KITTI images, noisy, dark or blurred,
    /// nine in ten of those just above it are right.
    pub min_confidence: f32,
    /// Side of the cells of which each keeps its most confident match, px at a width of 1241. Range [8, 200]; ours.
    pub cell_px: f32,
}

impl DenseSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        coarse_noise: 0.7,
        n_rounds: 2,
        min_support: 0.4,
        windows: WindowSettings::STANDARD,
        max_sigma_px: 1.0,
        max_deviation_px: 1.5,
        max_deviation_per_px: 0.04,
        min_confidence: 0.3,
        cell_px: 20.0,
    };
}

/// Matches two images without any prediction.
///
/// # Cost
/// O(pixels), about 100 ms for 1241 x 376 px; 5 KiB of stack; no allocation. Same bits on every SIMD level.
///
/// # Source
/// Revaud et al. 2016, "DeepMatching" (correlation volumes that neighbours share by max-pooling), here on a fixed grid;
/// refinement by Bouguet 2001 with windows deformed as the neighbours' flow says.
#[derive(Debug)]
pub struct DenseMatcher<'m> {
    simd: SimdLevel,
    settings: DenseSettings,
    storage: DenseStorage<'m>,
}

impl<'m> DenseMatcher<'m> {
    /// A matcher for images up to the size that `storage` was made for.
    ///
    /// # Errors
    /// [`DenseStorageTooSmall`] when a slice is shorter than `capacities` say.
    pub fn new(
        simd: SimdLevel,
        settings: DenseSettings,
        capacities: DenseCapacities,
        storage: DenseStorage<'m>,
    ) -> Result<Self, DenseStorageTooSmall> {
        storage.check(&capacities)?;
        Ok(Self { simd, settings, storage })
    }
}

impl PairMatcher for DenseMatcher<'_> {
    fn match_pair(&mut self, pair: &ImagePair<'_>, matches: &mut [PixelMatch]) -> usize {
        let Some(grid) = Grid::of(pair.keyframe, pair.current) else { return 0 };
        let Some(n_nodes) = self.storage.fit(&grid) else { return 0 };
        let DenseStorage { volume, pooled, planes, nodes, moved_nodes } = &mut self.storage;
        let nodes = &mut nodes[..n_nodes];
        volume::correlate(self.simd, pair, &grid, self.settings.coarse_noise, planes, volume);
        for round in 0..self.settings.n_rounds.min(3) {
            volume::share(self.simd, &grid, round, pooled, volume);
        }
        field::read_out(&grid, volume, nodes);
        for level in (0..grid.level).rev() {
            let tolerance = field::tolerance(level + 1);
            field::agree(&grid, tolerance, self.settings.min_support, nodes, moved_nodes);
            refine::refine(self.simd, pair, level, &self.settings, nodes);
        }
        field::agree(&grid, field::tolerance(1), self.settings.min_support, nodes, moved_nodes);
        field::keep_consistent(&grid, &self.settings, nodes, moved_nodes);
        write_matches(&self.settings, &grid, nodes, matches)
    }
}

/// The most confident node of every cell, most confident first.
fn write_matches(settings: &DenseSettings, grid: &Grid, nodes: &mut [DenseNode], matches: &mut [PixelMatch]) -> usize {
    let min_distance_px = settings.cell_px * grid.image_width() as f32 / REFERENCE_WIDTH_PX;
    nodes.sort_unstable_by(|a, b| {
        let order = b.confidence().total_cmp(&a.confidence());
        order.then(a.keyframe_px[1].total_cmp(&b.keyframe_px[1])).then(a.keyframe_px[0].total_cmp(&b.keyframe_px[0]))
    });
    let mut n = 0;
    for node in nodes.iter().filter(|node| node.is_alive && node.confidence() >= settings.min_confidence) {
        let far = |other: &PixelMatch| {
            let [dx, dy] = [0, 1].map(|k: usize| other.keyframe_px[k] - node.keyframe_px[k]);
            dx * dx + dy * dy >= min_distance_px * min_distance_px
        };
        if n < matches.len() && matches[..n].iter().all(far) {
            let (keyframe_px, current_px, confidence) = (node.keyframe_px, node.current_px, node.confidence());
            matches[n] = PixelMatch { keyframe_px, current_px, confidence };
            n += 1;
        }
    }
    n
}

#[cfg(test)]
mod tests;
