//! What a view works on: lists whose capacity is fixed, filled anew for every view.

use crate::splat::Capacities;
use crate::splat::kernel_constants as constants;
pub use constants::{LOG2_MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE};

use super::grid::{Grid, MAX_TILE_ROWS};

/// Most jobs that a stage over a list is cut into; fixed, so that sums do not depend on the thread count.
pub const MAX_JOBS: usize = 64;

/// A Gaussian as it is blended.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Splat {
    /// Mean, px.
    pub mean_px: [f32; 2],
    /// `[xx, xy, yy]` of `log2 alpha = xx dx^2 + xy dx dy + yy dy^2 + log2_opacity`.
    pub conic_log2: [f32; 3],
    /// Binary logarithm of the opacity.
    pub log2_opacity: f32,
    /// RGB.
    pub color: [f32; 3],
    /// Depth along the optical axis, m.
    pub depth_m: f32,
    /// Half width and height of the box around the ellipse where alpha is at least [`LOG2_MIN_ALPHA`], px.
    pub extent_px: [f32; 2],
    /// First and last pixel row of that box.
    pub rows_px: [u16; 2],
}

/// Numbers per splat that blending has gradients for:
/// moments `0, x, y, xx, xy, yy` of dL/dq, then RGB and depth.
pub const N_SPLAT_GRADS: usize = constants::N_SPLAT_GRADS as usize;
/// Position of RGB in a splat's gradients.
pub const GRAD_COLOR: usize = 6;
/// Position of the depth in a splat's gradients.
pub const GRAD_DEPTH: usize = 9;

/// A splat that meets a row of tiles.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Entry {
    /// Number in depth order.
    pub splat: u32,
    /// First column of tiles it may touch in this row.
    pub first_tile: u16,
    /// Last one; less than the first when there is none.
    pub last_tile: u16,
}

/// An entry that meets a tile.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pair {
    /// Number of the entry within its row of tiles.
    pub entry: u32,
    /// Blocks of the tile that it touches, one bit each.
    pub blocks: u32,
}

/// Buffers of one view.
pub struct Lists {
    /// Which Gaussians of each slot may be in view, one bit each.
    pub visible_bits: Vec<u32>,
    /// Gaussians that may be in view (`slot * k + i`), ascending.
    pub candidates: Vec<u32>,
    /// Splat of each candidate.
    pub splats: Vec<Splat>,
    /// `depth bits << 32 | candidate` of the splats that meet the picture; all ones for the others.
    pub keys: Vec<u64>,
    /// Scratch of the sort.
    pub keys_scratch: Vec<u64>,
    /// Number in depth order of each candidate, `u32::MAX` when it does not meet the picture.
    pub ranks: Vec<u32>,
    /// Splats by depth, nearest first.
    pub sorted: Vec<Splat>,
    /// Splats that meet each row of tiles, per job: [`MAX_JOBS`] times [`MAX_TILE_ROWS`].
    pub row_counts: Vec<u32>,
    /// Entries, row of tiles by row of tiles, by depth within a row.
    pub entries: Vec<Entry>,
    /// Pairs, tile by tile, by depth within a tile.
    pub pairs: Vec<Pair>,
    /// First and one past the last pair of each tile, counted from the first pair of its row of tiles.
    pub tile_ranges: Vec<[u32; 2]>,
    /// Gradients of the entries.
    pub entry_grads: Vec<[f32; N_SPLAT_GRADS]>,
    /// Gradients of the splats, in depth order.
    pub splat_grads: Vec<[f32; N_SPLAT_GRADS]>,
    /// Where each row of tiles begins in `entries`, and where the last one ends.
    pub entry_starts: [usize; MAX_TILE_ROWS + 1],
    /// Where each row of tiles begins in `pairs`, and where the last one ends.
    pub pair_starts: [usize; MAX_TILE_ROWS + 1],
}

/// Bytes per visible Gaussian.
pub const VISIBLE_BYTES: usize =
    2 * size_of::<u32>() + 2 * size_of::<Splat>() + 2 * size_of::<u64>() + size_of::<[f32; N_SPLAT_GRADS]>();
/// Bytes per row entry.
pub const ROW_ENTRY_BYTES: usize = size_of::<Entry>() + size_of::<[f32; N_SPLAT_GRADS]>();
/// Bytes per pair.
pub const PAIR_BYTES: usize = size_of::<Pair>();

impl Lists {
    /// Empty lists.
    pub fn new(capacities: &Capacities) -> Self {
        let grid = Grid::new(capacities.image_width_px as usize, capacities.image_height_px as usize);
        let n = capacities.visible_gaussians;
        Self {
            visible_bits: vec![0; capacities.anchors],
            candidates: vec![0; n],
            splats: vec![Splat::default(); n],
            keys: vec![0; n],
            keys_scratch: vec![0; n],
            ranks: vec![0; n],
            sorted: vec![Splat::default(); n],
            row_counts: vec![0; MAX_JOBS * MAX_TILE_ROWS],
            entries: vec![Entry::default(); capacities.row_entries],
            pairs: vec![Pair::default(); capacities.pairs],
            tile_ranges: vec![[0; 2]; grid.columns * grid.rows],
            entry_grads: vec![[0.0; N_SPLAT_GRADS]; capacities.row_entries],
            splat_grads: vec![[0.0; N_SPLAT_GRADS]; n],
            entry_starts: [0; MAX_TILE_ROWS + 1],
            pair_starts: [0; MAX_TILE_ROWS + 1],
        }
    }
}

/// Length of the pieces that a list of `n` is cut into: at most [`MAX_JOBS`] pieces, a multiple of 16.
pub fn piece_len(n: usize) -> usize {
    n.div_ceil(MAX_JOBS).next_multiple_of(16).max(16)
}

/// Cuts the front off a slice; the whole slice when it is shorter.
pub fn take_front<'a, T>(slice: &mut &'a mut [T], n: usize) -> &'a mut [T] {
    let all = core::mem::take(slice);
    let (front, rest) = all.split_at_mut(n.min(all.len()));
    *slice = rest;
    front
}
