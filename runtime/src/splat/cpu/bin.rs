//! Which splat touches which tile and block.
//!
//! An ellipse is cut into horizontal slabs; within a slab it covers an interval of columns, known in closed form.
//! Slabs of a row of tiles give the tiles, slabs of a row of blocks give the blocks. A pixel outside has an alpha
//! under that of [`LOG2_MIN_ALPHA`], so nothing that could be seen is left out.

use super::grid::{BLOCK_PX, BLOCKS_PER_SIDE, Grid, MAX_TILE_ROWS, TILE_PX};
use super::simd::Dispatch;
use super::splats::{Entry, LOG2_MIN_ALPHA, Lists, MAX_JOBS, Pair, Splat, take_front};
use super::splatting::pixels_within;
use crate::pool::Pool;
use pulp::{Simd, WithSimd};

/// How much was listed and what did not fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BinCounts {
    /// Entries of all rows of tiles.
    pub entries: usize,
    /// Entries that did not fit.
    pub entries_dropped: usize,
    /// Space for pairs that was asked for; an upper bound of the pairs.
    pub pairs: usize,
    /// Of it what did not fit.
    pub pairs_dropped: usize,
}

/// Lists the entries of every row of tiles and reserves the space of its pairs.
pub fn list_entries(pool: &Pool, dispatch: Dispatch, grid: &Grid, n_splats: usize, lists: &mut Lists) -> BinCounts {
    let mut counts = BinCounts::default();
    let capacity = lists.entries.len();
    let mut needed = 0;
    for row in 0..grid.rows {
        lists.entry_starts[row] = needed.min(capacity);
        needed += (0..MAX_JOBS).map(|job| lists.row_counts[job * MAX_TILE_ROWS + row] as usize).sum::<usize>();
    }
    lists.entry_starts[grid.rows] = needed.min(capacity);
    counts.entries = needed.min(capacity);
    counts.entries_dropped = needed - counts.entries;

    let sorted = &lists.sorted[..n_splats];
    let mut rest = &mut lists.entries[..];
    let mut jobs = heapless::Vec::<EntryJob<'_>, MAX_TILE_ROWS>::new();
    for row in 0..grid.rows {
        let entries = take_front(&mut rest, lists.entry_starts[row + 1] - lists.entry_starts[row]);
        if jobs.push(EntryJob { row, entries, n_pairs: 0 }).is_err() {
            unreachable!("a grid has at most MAX_TILE_ROWS rows");
        }
    }
    pool.for_each(&mut jobs, |_, job| dispatch.run(RunEntryJob(job, grid, sorted)));

    let capacity = lists.pairs.len();
    let mut needed = 0;
    for job in &jobs {
        lists.pair_starts[job.row] = needed.min(capacity);
        needed += job.n_pairs;
    }
    lists.pair_starts[grid.rows] = needed.min(capacity);
    counts.pairs = needed.min(capacity);
    counts.pairs_dropped = needed - counts.pairs;
    counts
}

struct EntryJob<'a> {
    row: usize,
    entries: &'a mut [Entry],
    n_pairs: usize,
}

struct RunEntryJob<'j, 'a>(&'j mut EntryJob<'a>, &'j Grid, &'j [Splat]);

impl WithSimd for RunEntryJob<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, _simd: S) {
        self.0.run(self.1, self.2);
    }
}

impl EntryJob<'_> {
    #[inline(always)]
    fn run(&mut self, grid: &Grid, sorted: &[Splat]) {
        let top = self.row * TILE_PX;
        let mut out = self.entries.iter_mut();
        let mut n_pairs = 0;
        for (i, splat) in sorted.iter().enumerate() {
            let [first_px, last_px] = splat.rows_px.map(usize::from);
            if last_px < top || first_px >= top + TILE_PX {
                continue;
            }
            let Some(entry) = out.next() else { break };
            let slab = [top.max(first_px) as f32, last_px.min(top + TILE_PX - 1) as f32];
            let [first, last] = Ellipse::of(splat).columns_in(slab, grid.width);
            let [first_tile, last_tile] =
                if first <= last { [first / TILE_PX as i32, last / TILE_PX as i32] } else { [1, 0] };
            n_pairs += (last_tile + 1 - first_tile) as usize;
            let [first_tile, last_tile] = [first_tile as u16, last_tile as u16];
            *entry = Entry { splat: i as u32, first_tile, last_tile };
        }
        self.n_pairs = n_pairs;
    }
}

/// Fills the pairs of one row of tiles, tile by tile and by depth within a tile; returns how many there are.
#[inline(always)]
pub fn list_pairs(
    grid: &Grid,
    row: usize,
    sorted: &[Splat],
    entries: &[Entry],
    pairs: &mut [Pair],
    tile_ranges: &mut [[u32; 2]],
) -> usize {
    tile_ranges.fill([0; 2]);
    for entry in entries {
        for tile in entry.first_tile..=entry.last_tile {
            tile_ranges[usize::from(tile)][1] += 1;
        }
    }
    let mut needed = 0;
    for range in tile_ranges.iter_mut() {
        let n = range[1];
        // What does not fit has an empty range at the end.
        *range = [needed.min(pairs.len() as u32); 2];
        needed += n;
    }
    let top = row * TILE_PX;
    for (i, entry) in entries.iter().enumerate() {
        if entry.first_tile > entry.last_tile {
            continue;
        }
        let slabs = block_columns(&sorted[entry.splat as usize], top, grid.width);
        for tile in entry.first_tile..=entry.last_tile {
            let blocks = blocks_of_tile(&slabs, i32::from(tile) * TILE_PX as i32);
            let end = &mut tile_ranges[usize::from(tile)][1];
            if blocks != 0
                && let Some(pair) = pairs.get_mut(*end as usize)
            {
                *pair = Pair { entry: i as u32, blocks };
                *end += 1;
            }
        }
    }
    tile_ranges.iter().map(|[first, end]| (end - first) as usize).sum()
}

/// First and last pixel column that a splat reaches in each row of blocks of a row of tiles; the first is larger
/// where it reaches none.
#[inline(always)]
fn block_columns(splat: &Splat, top: usize, width: usize) -> [[i32; 2]; BLOCKS_PER_SIDE] {
    let ellipse = Ellipse::of(splat);
    let [first_px, last_px] = [f32::from(splat.rows_px[0]), f32::from(splat.rows_px[1])];
    let mut out = [NO_COLUMNS; BLOCKS_PER_SIDE];
    for (block_row, columns) in out.iter_mut().enumerate() {
        let block_top = (top + block_row * BLOCK_PX) as f32;
        let slab = [block_top.max(first_px), last_px.min(block_top + (BLOCK_PX - 1) as f32)];
        if slab[0] <= slab[1] {
            *columns = ellipse.columns_in(slab, width);
        }
    }
    out
}

/// An interval without columns.
const NO_COLUMNS: [i32; 2] = [1, 0];

/// Bit mask of the blocks of a tile, given the tile's first pixel column.
#[inline(always)]
fn blocks_of_tile(slabs: &[[i32; 2]; BLOCKS_PER_SIDE], left: i32) -> u32 {
    const LAST: i32 = TILE_PX as i32 - 1;
    let mut blocks = 0;
    for (block_row, &[first, last]) in slabs.iter().enumerate() {
        let (first, last) = ((first - left).max(0), (last - left).min(LAST));
        if first <= last {
            let (low, high) = (first as u32 / BLOCK_PX as u32, last as u32 / BLOCK_PX as u32);
            blocks |= ((2u32 << high) - (1u32 << low)) << (block_row * BLOCKS_PER_SIDE);
        }
    }
    blocks
}

/// The border where a splat's alpha is the smallest that can be seen.
///
/// # Source
/// Own derivation: with `xx dx^2 + xy dx dy + yy dy^2 + reach = 0` (all coefficients of `log2 alpha`) a row `dy`
/// spans `slope dy -+ half sqrt(1 - (dy / height)^2)`, widest at `dy = -+ lean`; both ends are concave in `dy`.
struct Ellipse {
    mean_px: [f32; 2],
    /// Horizontal shift of a row's middle per px of dy.
    slope: f32,
    /// Half length of the row through the mean, px.
    half_px: f32,
    /// dy of the rightmost point; the leftmost one is opposite.
    lean_px: f32,
    /// One over half the height, 1/px.
    inverse_height: f32,
}

impl Ellipse {
    #[inline(always)]
    fn of(splat: &Splat) -> Self {
        let [xx, xy, yy] = splat.conic_log2;
        let reach = splat.log2_opacity - LOG2_MIN_ALPHA;
        Self {
            mean_px: splat.mean_px,
            slope: -0.5 * xy / xx,
            half_px: (-reach / xx).sqrt(),
            lean_px: -0.5 * xy / yy * splat.extent_px[0],
            inverse_height: 1.0 / splat.extent_px[1],
        }
    }

    /// First and last pixel column of the ellipse within the pixel rows `first..=last`; the first is larger where
    /// there is none.
    #[inline(always)]
    fn columns_in(&self, [first, last]: [f32; 2], width: usize) -> [i32; 2] {
        let low = first + 0.5 - self.mean_px[1];
        let high = last + 0.5 - self.mean_px[1];
        let leftmost = (-self.lean_px).max(low).min(high);
        let rightmost = self.lean_px.max(low).min(high);
        let left = self.slope * leftmost - self.half_width_px(leftmost);
        let right = self.slope * rightmost + self.half_width_px(rightmost);
        pixels_within(self.mean_px[0], left, right, width)
    }

    #[inline(always)]
    fn half_width_px(&self, dy: f32) -> f32 {
        let relative = dy * self.inverse_height;
        self.half_px * (1.0 - relative * relative).max(0.0).sqrt()
    }
}
