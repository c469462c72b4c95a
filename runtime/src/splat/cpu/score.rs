//! Which anchors contribute to a view, and where it is wrong: one more walk front to back over the pixels.
//!
//! Counts are kept in place of the gradients of entries and splats. They are exact there: a picture has at most 2^24
//! pixels, and integers up to that are numbers of `f32`.

use super::backend::CpuBackend;
use super::blend::{BATCH, SplatLanes, block_has_ended, block_offset_px, fetch};
use super::draw::{Drawn, Machine};
use super::grid::{
    BLOCK_PIXELS, Grid, MAX_TILE_ROWS, TILE_BLOCKS, TILE_PIXELS, TILE_PX, gather_tile, pixel_in_block_order,
};
use super::lane::{Lane, Wide};
use super::loss::LossInput;
use super::reduce::reduce;
use super::splats::{Entry, Lists, MIN_TRANSMITTANCE, N_SPLAT_GRADS, Pair, Splat, take_front};
use crate::splat::kernel_constants::{MAX_IMAGE_SIDE_PX, MIN_CONTRIBUTION};
use crate::splat::{AnchorScore, LossWeights, ScoreReport, TrainingView};
use core::cmp::Reverse;
use pulp::{Simd, WithSimd};

const _: () = assert!(MAX_IMAGE_SIDE_PX * MAX_IMAGE_SIDE_PX <= 1 << f32::MANTISSA_DIGITS, "counts are exact");

/// Place of the contributions among a splat's gradients.
const COVERED: usize = 0;
/// Place of those where the picture is wrong.
const MASKED: usize = 1;

impl CpuBackend {
    /// Draws a view and scores every slot.
    pub(super) fn score(
        &mut self,
        training: &TrainingView<'_>,
        error_threshold: f32,
        scores: &mut [AnchorScore],
    ) -> ScoreReport {
        let drawn = self.draw(&training.view);
        let n_pixels = drawn.grid.n_pixels();
        let input = LossInput {
            width: drawn.grid.width,
            target: training.target,
            depth: None,
            exposure: training.exposure_slot.and_then(|slot| self.exposures.get(slot)),
            weights: LossWeights::PHOTOMETRIC,
        };
        let (loss, _) = self.loss.evaluate(&self.pool, self.dispatch, &input, self.view.drawn(n_pixels));
        let masked_pixels = self.loss.mark_errors(n_pixels, error_threshold);
        self.view.clock.finish("loss");
        let machine = Machine { pool: &self.pool, dispatch: self.dispatch };
        count_contributions(machine, &drawn, self.loss.error_marks(n_pixels), &mut self.view.lists);
        self.view.clock.finish("score");
        reduce(&self.pool, &drawn.grid, drawn.n_splats, &mut self.view.lists);
        collect(&self.view.lists, drawn.n_candidates, self.anchors.k, scores);
        self.view.clock.finish("reduce");
        ScoreReport { loss, masked_pixels, stats: drawn.stats }
    }
}

/// Fills the first two gradients of every entry with its contributions and with those that are marked.
fn count_contributions(machine: Machine<'_>, drawn: &Drawn, marks: &[f32], lists: &mut Lists) {
    let grid = drawn.grid;
    let mut rest = &mut lists.entry_grads[..];
    let mut jobs = heapless::Vec::<ScoreJob<'_>, MAX_TILE_ROWS>::new();
    for row in 0..grid.rows {
        let entries = lists.entry_starts[row]..lists.entry_starts[row + 1];
        let first = row * grid.tile_row_pixels();
        let job = ScoreJob {
            row,
            grid,
            sorted: &lists.sorted[..drawn.n_splats],
            entries: &lists.entries[entries.clone()],
            pairs: &lists.pairs[lists.pair_starts[row]..lists.pair_starts[row + 1]],
            tile_ranges: &lists.tile_ranges[row * grid.columns..(row + 1) * grid.columns],
            marks: &marks[first..(first + grid.tile_row_pixels()).min(marks.len())],
            counts: take_front(&mut rest, entries.len()),
        };
        if jobs.push(job).is_err() {
            unreachable!("a grid has at most MAX_TILE_ROWS rows");
        }
    }
    jobs.sort_unstable_by_key(|job| (Reverse(job.pairs.len()), job.row));
    machine.pool.for_each(&mut jobs, |_, job| machine.dispatch.run(RunScoreJob(job)));
}

/// From the splats' counts and sizes to those of the slots.
fn collect(lists: &Lists, n_candidates: usize, k: usize, scores: &mut [AnchorScore]) {
    scores.fill(AnchorScore::default());
    for ((&id, &rank), splat) in lists.candidates[..n_candidates].iter().zip(&lists.ranks).zip(&lists.splats) {
        if rank == u32::MAX {
            continue;
        }
        let counts = &lists.splat_grads[rank as usize];
        let score = &mut scores[id as usize / k];
        score.covered += counts[COVERED] as u32;
        score.masked += counts[MASKED] as u32;
        score.radius_px = score.radius_px.max(splat.extent_px[0]).max(splat.extent_px[1]);
    }
}

/// One row of tiles: its lists, and which of its pixels are wrong.
struct ScoreJob<'a> {
    row: usize,
    grid: Grid,
    sorted: &'a [Splat],
    entries: &'a [Entry],
    pairs: &'a [Pair],
    tile_ranges: &'a [[u32; 2]],
    marks: &'a [f32],
    counts: &'a mut [[f32; N_SPLAT_GRADS]],
}

struct RunScoreJob<'j, 'a>(&'j mut ScoreJob<'a>);

impl WithSimd for RunScoreJob<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        job.counts.fill([0.0; N_SPLAT_GRADS]);
        let mut tile = Tile { transmittance: [0.0; TILE_PIXELS], marks: [0.0; TILE_PIXELS] };
        for (column, range) in job.tile_ranges.iter().enumerate() {
            let [first, end] = range.map(|i| i as usize);
            if first == end {
                continue;
            }
            tile.begin(job, column);
            let corner_px = [(column * TILE_PX) as f32, (job.row * TILE_PX) as f32];
            tile.walk(simd, job.sorted, job.entries, &job.pairs[first..end], corner_px, job.counts);
        }
    }
}

/// State of a tile's pixels, in block order.
#[repr(align(64))]
struct Tile {
    transmittance: [f32; TILE_PIXELS],
    marks: [f32; TILE_PIXELS],
}

impl Tile {
    /// Pixels beyond the picture's border have ended from the start.
    fn begin(&mut self, job: &ScoreJob<'_>, column: usize) {
        let (width, tile_x) = (job.grid.width, column * TILE_PX);
        gather_tile(job.marks, width, tile_x, &mut self.marks);
        self.transmittance.fill(-1.0);
        let n_rows = job.marks.len() / width;
        for y in 0..TILE_PX.min(n_rows) {
            for x in 0..TILE_PX.min(width - tile_x) {
                self.transmittance[pixel_in_block_order(x, y)] = 1.0;
            }
        }
    }

    #[inline(always)]
    fn walk<S: Simd>(
        &mut self,
        simd: S,
        sorted: &[Splat],
        entries: &[Entry],
        pairs: &[Pair],
        corner_px: [f32; 2],
        counts: &mut [[f32; N_SPLAT_GRADS]],
    ) {
        let mut alive_blocks = (1u32 << TILE_BLOCKS) - 1;
        let mut batch = [Splat::default(); BATCH];
        for pairs in pairs.chunks(BATCH) {
            fetch(sorted, entries, pairs, &mut batch);
            for (pair, splat) in pairs.iter().zip(&batch) {
                let lanes = SplatLanes::new(simd, splat);
                let from_mean_px = [corner_px[0] - splat.mean_px[0], corner_px[1] - splat.mean_px[1]];
                let mut sums = [Wide::splat(simd, 0.0); 2];
                let mut blocks = pair.blocks & alive_blocks;
                while blocks != 0 {
                    let block = blocks.trailing_zeros() as usize % TILE_BLOCKS;
                    blocks &= blocks - 1;
                    let offset_px = block_offset_px(block, from_mean_px);
                    let ended = self.count_block(simd, &lanes, block, offset_px, &mut sums);
                    if ended && block_has_ended(simd, &self.transmittance, block) {
                        alive_blocks &= !(1 << block);
                    }
                }
                let counts = &mut counts[pair.entry as usize];
                counts[COVERED] += sums[COVERED].sum();
                counts[MASKED] += sums[MASKED].sum();
            }
            if alive_blocks == 0 {
                return;
            }
        }
    }

    /// Adds the contributions of one splat to one block to `sums`; true when a pixel has ended.
    #[inline(always)]
    fn count_block<S: Simd>(
        &mut self,
        simd: S,
        splat: &SplatLanes<S>,
        block: usize,
        offset_px: [f32; 2],
        sums: &mut [Wide<S>; 2],
    ) -> bool {
        let mut any_ended = false;
        for lane in (0..BLOCK_PIXELS).step_by(S::F32_LANES) {
            let hit = splat.hit(simd, lane, offset_px);
            let at = block * BLOCK_PIXELS + lane;
            let pixels = at..at + S::F32_LANES;
            let before = Wide::load(simd, &self.transmittance[pixels.clone()]);
            let weight = hit.alpha * before;
            let after = before - weight;
            let zero = before.zero();
            let goes_on = before.constant(f64::from(MIN_TRANSMITTANCE)).lt(after);
            let weight = zero.replace(before.and(hit.seen, goes_on), weight);
            let contributes =
                weight.constant(1.0).replace(weight.lt(weight.constant(f64::from(MIN_CONTRIBUTION))), zero);
            sums[COVERED] = sums[COVERED] + contributes;
            sums[MASKED] = contributes.mul_add(Wide::load(simd, &self.marks[pixels.clone()]), sums[MASKED]);
            // What is behind less than the least contribution contributes nothing. A pixel that has ended is negative, so
            // that it never goes on.
            let shows_more = before.constant(f64::from(MIN_CONTRIBUTION)).lt(after);
            let next = (-before.abs()).replace(shows_more, after);
            any_ended |= next.any(before.and(hit.seen, next.lt(zero)));
            before.replace(hit.seen, next).store(&mut self.transmittance[pixels]);
        }
        any_ended
    }
}
