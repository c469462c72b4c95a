//! Gradients of blending, row of tiles by row of tiles.
//!
//! The pixels are walked front to back once more: the same conditions give the same transmittances, and what lies
//! behind a Gaussian is what is left of the pixel's total. Nothing per pair was kept.

use super::blend::{BATCH, SplatLanes, block_has_ended, block_offset_px, fetch};
use super::grid::{BLOCK_PIXELS, Grid, TILE_BLOCKS, TILE_PIXELS, TILE_PX, gather_tile};
use super::lane::{Lane, Wide};
use super::splats::{Entry, GRAD_COLOR, MAX_ALPHA, MIN_TRANSMITTANCE, N_SPLAT_GRADS, Pair, Splat};
use pulp::{Simd, WithSimd};

/// One row of tiles: its lists, what was drawn, and the gradients with respect to it.
pub struct BlendBackwardJob<'a> {
    /// Number of the row of tiles.
    pub row: usize,
    /// Size of the picture.
    pub grid: Grid,
    /// All splats by depth.
    pub sorted: &'a [Splat],
    /// Entries of this row.
    pub entries: &'a [Entry],
    /// Pairs of this row.
    pub pairs: &'a [Pair],
    /// Ranges of this row's tiles.
    pub tile_ranges: &'a [[u32; 2]],
    /// Red, green, blue (with the background), depth, transmittance of this row, as drawn.
    pub drawn: [&'a [f32]; 5],
    /// Gradients with respect to them (that of the transmittance without the background).
    pub upstream: [&'a [f32]; 5],
    /// Gradients of the entries.
    pub entry_grads: &'a mut [[f32; N_SPLAT_GRADS]],
}

/// Fills the gradients of a row of tiles.
pub struct BlendBackward<'j, 'a>(pub &'j mut BlendBackwardJob<'a>);

impl WithSimd for BlendBackward<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        job.entry_grads.fill([0.0; N_SPLAT_GRADS]);
        let mut tile = TileGradients::new();
        for (column, range) in job.tile_ranges.iter().enumerate() {
            let [first, end] = range.map(|i| i as usize);
            if first == end {
                continue;
            }
            tile.load(&job.drawn, &job.upstream, job.grid.width, column * TILE_PX);
            let corner_px = [(column * TILE_PX) as f32, (job.row * TILE_PX) as f32];
            tile.walk(simd, job.sorted, job.entries, &job.pairs[first..end], corner_px, job.entry_grads);
        }
    }
}

/// State of a tile's pixels, in block order.
#[repr(align(64))]
struct TileGradients {
    transmittance: [f32; TILE_PIXELS],
    /// Loss gradient times what lies from here to the back.
    remaining: [f32; TILE_PIXELS],
    /// Gradients with respect to red, green, blue, depth.
    upstream: [[f32; TILE_PIXELS]; 4],
    scratch: [[f32; TILE_PIXELS]; 2],
}

impl TileGradients {
    fn new() -> Self {
        const ZERO: [f32; TILE_PIXELS] = [0.0; TILE_PIXELS];
        Self { transmittance: ZERO, remaining: ZERO, upstream: [ZERO; 4], scratch: [ZERO; 2] }
    }

    #[inline(always)]
    fn load(&mut self, drawn: &[&[f32]; 5], upstream: &[&[f32]; 5], width: usize, tile_x: usize) {
        self.transmittance.fill(1.0);
        self.remaining.fill(0.0);
        for i in 0..5 {
            gather_tile(drawn[i], width, tile_x, &mut self.scratch[0]);
            let [values, last] = &mut self.scratch;
            let gradient = self.upstream.get_mut(i).unwrap_or(last);
            gather_tile(upstream[i], width, tile_x, gradient);
            for ((remaining, value), gradient) in self.remaining.iter_mut().zip(values).zip(gradient) {
                *remaining += *value * *gradient;
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
        entry_grads: &mut [[f32; N_SPLAT_GRADS]],
    ) {
        let mut alive_blocks = (1u32 << TILE_BLOCKS) - 1;
        let mut batch = [Splat::default(); BATCH];
        for pairs in pairs.chunks(BATCH) {
            fetch(sorted, entries, pairs, &mut batch);
            for (pair, splat) in pairs.iter().zip(&batch) {
                let mut blocks = pair.blocks & alive_blocks;
                if blocks == 0 {
                    continue;
                }
                let lanes = SplatLanes::new(simd, splat);
                let from_mean_px = [corner_px[0] - splat.mean_px[0], corner_px[1] - splat.mean_px[1]];
                let mut sums = [Wide::splat(simd, 0.0); N_SPLAT_GRADS];
                while blocks != 0 {
                    let block = blocks.trailing_zeros() as usize % TILE_BLOCKS;
                    blocks &= blocks - 1;
                    let ended = self.walk_block(simd, &lanes, block, block_offset_px(block, from_mean_px), &mut sums);
                    if ended && block_has_ended(simd, &self.transmittance, block) {
                        alive_blocks &= !(1 << block);
                    }
                }
                let totals = &mut entry_grads[pair.entry as usize];
                for i in 0..N_SPLAT_GRADS {
                    totals[i] += sums[i].sum();
                }
            }
            if alive_blocks == 0 {
                return;
            }
        }
    }

    /// Adds one splat's gradients over one block to `sums`; true when a pixel has ended.
    ///
    /// # Source
    /// Kerbl et al. 2023, app. C, with "what lies behind" as total minus what lies in front (own form):
    /// `dL/dalpha = T v - behind / (1 - alpha)`, `v = color . dL/dcolor + depth dL/ddepth`.
    #[inline(always)]
    fn walk_block<S: Simd>(
        &mut self,
        simd: S,
        splat: &SplatLanes<S>,
        block: usize,
        offset_px: [f32; 2],
        sums: &mut [Wide<S>; N_SPLAT_GRADS],
    ) -> bool {
        let mut any_ended = false;
        for lane in (0..BLOCK_PIXELS).step_by(S::F32_LANES) {
            let hit = splat.hit(simd, lane, offset_px);
            let at = block * BLOCK_PIXELS + lane;
            let pixels = at..at + S::F32_LANES;
            let before = Wide::load(simd, &self.transmittance[pixels.clone()]);
            let after = before - hit.alpha * before;
            let zero = before.zero();
            let goes_on = before.constant(f64::from(MIN_TRANSMITTANCE)).lt(after);
            let blended = before.and(hit.seen, goes_on);
            let weight = zero.replace(blended, hit.alpha * before);
            let mut value = zero;
            for i in 0..4 {
                let upstream = Wide::load(simd, &self.upstream[i][pixels.clone()]);
                value = splat.values[i].mul_add(upstream, value);
                sums[GRAD_COLOR + i] = weight.mul_add(upstream, sums[GRAD_COLOR + i]);
            }
            let remaining = Wide::load(simd, &self.remaining[pixels.clone()]);
            let behind = (-weight).mul_add(value, remaining);
            behind.store(&mut self.remaining[pixels.clone()]);
            let grad_alpha = before * value - behind / (before.constant(1.0) - hit.alpha);
            let uncapped = before.and(blended, hit.uncapped.lt(before.constant(f64::from(MAX_ALPHA))));
            let grad_q = zero.replace(uncapped, -grad_alpha * hit.alpha);
            let (by_x, by_y) = (grad_q * hit.dx, grad_q * hit.dy);
            sums[0] = sums[0] + grad_q;
            sums[1] = sums[1] + by_x;
            sums[2] = sums[2] + by_y;
            sums[3] = by_x.mul_add(hit.dx, sums[3]);
            sums[4] = by_x.mul_add(hit.dy, sums[4]);
            sums[5] = by_y.mul_add(hit.dy, sums[5]);
            let next = (-before.abs()).replace(goes_on, after);
            any_ended |= next.any(before.and(hit.seen, next.lt(zero)));
            before.replace(hit.seen, next).store(&mut self.transmittance[pixels]);
        }
        any_ended
    }
}
