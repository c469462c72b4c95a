//! The memory that the dense matcher works in: counted by the budget, handed in by the caller.

use super::field::DenseNode;
use super::volume::{BYTES_PER_NODE, PLANES, plane_len};
use crate::frame::Pyramid;
use core::fmt;

/// Level px between two nodes of the grid.
pub(super) const STRIDE: usize = 2;

/// Widest level that is searched exhaustively, px: KITTI's 1241 px are matched at an eighth.
const COARSE_WIDTH_PX: usize = 176;

/// Levels of the pyramids that are looked at, the full image included.
const LEVELS: usize = 4;

/// The grid of nodes on the coarsest level.
#[derive(Clone, Copy, Debug)]
pub(super) struct Grid {
    /// Level that is searched exhaustively.
    pub(super) level: usize,
    /// Its size, px.
    pub(super) width: usize,
    pub(super) height: usize,
    /// Nodes per row and column.
    pub(super) columns: usize,
    pub(super) rows: usize,
}

impl Grid {
    /// `None` when the images differ in size or are too small to be halved.
    pub(super) fn of(keyframe: &Pyramid<'_>, current: &Pyramid<'_>) -> Option<Self> {
        let size = |pyramid: &Pyramid<'_>| (pyramid.width(), pyramid.height());
        let n_levels = keyframe.n_levels().min(current.n_levels());
        (size(keyframe) == size(current)).then(|| Self::new(keyframe.width(), keyframe.height(), n_levels)).flatten()
    }

    fn new(width: usize, height: usize, n_levels: usize) -> Option<Self> {
        let fits = |level: &usize| width >> level <= COARSE_WIDTH_PX;
        let level = (1..n_levels.min(LEVELS)).find(fits).unwrap_or(n_levels.min(LEVELS).saturating_sub(1));
        let (width, height) = (width >> level, height >> level);
        let (columns, rows) = (width / STRIDE, height / STRIDE);
        (level > 0 && columns > 0 && rows > 0).then_some(Self { level, width, height, columns, rows })
    }

    /// Width of the full image, to less than a pixel of the level.
    pub(super) fn image_width(&self) -> usize {
        self.width << self.level
    }

    pub(super) fn n_nodes(&self) -> usize {
        self.columns * self.rows
    }
}

/// Images that a [`DenseMatcher`](super::DenseMatcher) can match.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DenseCapacities {
    /// Image width, px.
    pub width: usize,
    /// Image height, px.
    pub height: usize,
}

impl DenseCapacities {
    /// Nodes of the grid.
    pub fn nodes(&self) -> usize {
        self.grid().map_or(0, |grid| grid.n_nodes())
    }

    /// Bytes of each of the two volumes.
    pub fn volume_bytes(&self) -> usize {
        self.nodes() * BYTES_PER_NODE
    }

    /// Numbers of the planes.
    pub fn planes(&self) -> usize {
        self.grid().map_or(0, |grid| PLANES * plane_len(&grid))
    }

    /// Bytes of all slices of a [`DenseStorage`].
    pub fn bytes(&self) -> usize {
        2 * self.volume_bytes() + self.planes() * size_of::<f32>() + 2 * self.nodes() * size_of::<DenseNode>()
    }

    fn grid(&self) -> Option<Grid> {
        Grid::new(self.width, self.height, LEVELS)
    }
}

/// Memory of a [`DenseMatcher`](super::DenseMatcher); the lengths are those of [`DenseCapacities`].
#[derive(Debug)]
pub struct DenseStorage<'m> {
    /// How well each displacement of each node fits.
    pub volume: &'m mut [u8],
    /// Scratch: the same, the best of neighbouring displacements.
    pub pooled: &'m mut [u8],
    /// Scratch: the coarsest level of the current frame.
    pub planes: &'m mut [f32],
    /// The nodes.
    pub nodes: &'m mut [DenseNode],
    /// Scratch: the nodes after a step.
    pub moved_nodes: &'m mut [DenseNode],
}

impl DenseStorage<'_> {
    pub(super) fn check(&self, capacities: &DenseCapacities) -> Result<(), DenseStorageTooSmall> {
        let lengths = [
            ("volume", self.volume.len(), capacities.volume_bytes()),
            ("pooled", self.pooled.len(), capacities.volume_bytes()),
            ("planes", self.planes.len(), capacities.planes()),
            ("nodes", self.nodes.len(), capacities.nodes()),
            ("moved_nodes", self.moved_nodes.len(), capacities.nodes()),
        ];
        let short = lengths.into_iter().find(|(_, found, needed)| found < needed);
        short.map_or(Ok(()), |(what, found, needed)| Err(DenseStorageTooSmall { what, found, needed }))
    }

    /// Number of nodes when the grid fits.
    pub(super) fn fit(&self, grid: &Grid) -> Option<usize> {
        let n_nodes = grid.n_nodes();
        let volume = self.volume.len().min(self.pooled.len()) / BYTES_PER_NODE;
        let fits = n_nodes <= volume
            && n_nodes <= self.nodes.len().min(self.moved_nodes.len())
            && PLANES * plane_len(grid) <= self.planes.len();
        fits.then_some(n_nodes)
    }
}

/// A slice of a [`DenseStorage`] does not fit the capacities: a mistake of the caller, to be mended there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DenseStorageTooSmall {
    /// Which slice.
    pub what: &'static str,
    /// Its length.
    pub found: usize,
    /// The length needed.
    pub needed: usize,
}

impl fmt::Display for DenseStorageTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "dense matcher: {} has {} elements, {} needed", self.what, self.found, self.needed)
    }
}

impl core::error::Error for DenseStorageTooSmall {}
