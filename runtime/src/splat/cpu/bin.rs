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
            let columns = Ellipse::of(splat).columns_in(top.max(first_px), last_px.min(top + TILE_PX - 1), grid.width);
            let [first_tile, last_tile] = columns.map_or([1, 0], |c| c.map(|px| (px / TILE_PX) as u16));
            n_pairs += usize::from((last_tile + 1).saturating_sub(first_tile));
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
    let mut start = 0;
    for range in tile_ranges.iter_mut() {
        let n = range[1];
        *range = [start, start];
        start += n;
    }
    let top = row * TILE_PX;
    for (i, entry) in entries.iter().enumerate() {
        if entry.first_tile > entry.last_tile {
            continue;
        }
        let slabs = block_columns(&sorted[entry.splat as usize], top, grid.width);
        for tile in entry.first_tile..=entry.last_tile {
            let blocks = blocks_of_tile(&slabs, usize::from(tile) * BLOCKS_PER_SIDE);
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

/// First and last column of blocks in each row of blocks of a row of tiles.
#[inline(always)]
fn block_columns(splat: &Splat, top: usize, width: usize) -> [Option<[usize; 2]>; BLOCKS_PER_SIDE] {
    let ellipse = Ellipse::of(splat);
    let [first_px, last_px] = splat.rows_px.map(usize::from);
    core::array::from_fn(|block_row| {
        let block_top = top + block_row * BLOCK_PX;
        let (first, last) = (block_top.max(first_px), last_px.min(block_top + BLOCK_PX - 1));
        if first > last {
            return None;
        }
        ellipse.columns_in(first, last, width).map(|c| c.map(|px| px / BLOCK_PX))
    })
}

/// Bit mask of the blocks of the tile whose first column of blocks is given.
#[inline(always)]
fn blocks_of_tile(slabs: &[Option<[usize; 2]>; BLOCKS_PER_SIDE], first_column: usize) -> u32 {
    let mut blocks = 0;
    for (block_row, slab) in slabs.iter().enumerate() {
        let Some([first, last]) = *slab else { continue };
        if last < first_column || first >= first_column + BLOCKS_PER_SIDE {
            continue;
        }
        let low = first.saturating_sub(first_column);
        let high = (last - first_column).min(BLOCKS_PER_SIDE - 1);
        blocks |= (((1u32 << (high - low + 1)) - 1) << low) << (block_row * BLOCKS_PER_SIDE);
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
    height_px: f32,
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
            height_px: splat.extent_px[1],
        }
    }

    /// First and last pixel column of the ellipse within pixel rows `first..=last`.
    #[inline(always)]
    fn columns_in(&self, first: usize, last: usize, width: usize) -> Option<[usize; 2]> {
        let low = first as f32 + 0.5 - self.mean_px[1];
        let high = last as f32 + 0.5 - self.mean_px[1];
        let end = |lean: f32, side: f32| {
            let dy = lean.max(low).min(high);
            let relative = dy / self.height_px;
            self.slope * dy + side * self.half_px * (1.0 - relative * relative).max(0.0).sqrt()
        };
        pixels_within(self.mean_px[0], end(-self.lean_px, -1.0), end(self.lean_px, 1.0), width)
    }
}
