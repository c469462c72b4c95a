//! Front-to-back blending of one row of tiles.

use super::bin::list_pairs;
use super::grid::{
    BLOCK_PIXELS, BLOCK_PX, BLOCK_X_PX, BLOCK_Y_PX, BLOCKS_PER_SIDE, Grid, TILE_BLOCKS, TILE_PIXELS, TILE_PX,
    scatter_tile,
};
use super::lane::{Lane, Wide, each};
use super::splats::{Entry, LOG2_MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, Pair, Splat};
use pulp::{Simd, WithSimd};

/// Floor of the exponent: keeps `exp2` within normal numbers far from a splat.
const MIN_LOG2_ALPHA: f64 = -126.0;

/// One row of tiles: its lists and its share of the picture.
pub struct BlendJob<'a> {
    /// Number of the row of tiles.
    pub row: usize,
    /// Size of the picture.
    pub grid: Grid,
    /// All splats by depth.
    pub sorted: &'a [Splat],
    /// Entries of this row.
    pub entries: &'a [Entry],
    /// Space for the pairs of this row.
    pub pairs: &'a mut [Pair],
    /// Ranges of this row's tiles.
    pub tile_ranges: &'a mut [[u32; 2]],
    /// Red, green, blue, depth, transmittance of this row, pixel row by pixel row.
    pub planes: [&'a mut [f32]; 5],
    /// Pairs listed.
    pub n_pairs: usize,
}

/// Lists the pairs of a row of tiles and blends them over nothing.
pub struct Blend<'j, 'a>(pub &'j mut BlendJob<'a>);

impl WithSimd for Blend<'_, '_> {
    type Output = ();
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let job = self.0;
        job.n_pairs = list_pairs(&job.grid, job.row, job.sorted, job.entries, job.pairs, job.tile_ranges);
        let mut tile = Tile::new();
        for (column, range) in job.tile_ranges.iter().enumerate() {
            tile.clear();
            let [first, end] = range.map(|i| i as usize);
            let corner_px = [(column * TILE_PX) as f32, (job.row * TILE_PX) as f32];
            tile.blend(simd, job.sorted, job.entries, &job.pairs[first..end], corner_px);
            for (plane, channel) in job.planes.iter_mut().zip(&tile.channels) {
                scatter_tile(channel, job.grid.width, column * TILE_PX, plane);
            }
            // A pixel that has ended keeps its transmittance with a minus sign.
            let transmittance = tile.channels[TRANSMITTANCE].map(f32::abs);
            scatter_tile(&transmittance, job.grid.width, column * TILE_PX, job.planes[TRANSMITTANCE]);
        }
    }
}

const TRANSMITTANCE: usize = 4;

/// State of a tile's pixels, in block order.
#[repr(align(64))]
struct Tile {
    channels: [[f32; TILE_PIXELS]; 5],
}

impl Tile {
    fn new() -> Self {
        Self { channels: [[0.0; TILE_PIXELS]; 5] }
    }

    fn clear(&mut self) {
        self.channels[..TRANSMITTANCE].as_flattened_mut().fill(0.0);
        self.channels[TRANSMITTANCE].fill(1.0);
    }

    #[inline(always)]
    fn blend<S: Simd>(&mut self, simd: S, sorted: &[Splat], entries: &[Entry], pairs: &[Pair], corner_px: [f32; 2]) {
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
                while blocks != 0 {
                    let block = blocks.trailing_zeros() as usize % TILE_BLOCKS;
                    blocks &= blocks - 1;
                    let ended = self.blend_block(simd, &lanes, block, block_offset_px(block, from_mean_px));
                    if ended && block_has_ended(simd, &self.channels[TRANSMITTANCE], block) {
                        alive_blocks &= !(1 << block);
                    }
                }
            }
            if alive_blocks == 0 {
                return;
            }
        }
    }

    /// Blends one splat into one block; true when a pixel has ended.
    #[inline(always)]
    fn blend_block<S: Simd>(&mut self, simd: S, splat: &SplatLanes<S>, block: usize, offset_px: [f32; 2]) -> bool {
        let mut any_ended = false;
        for lane in (0..BLOCK_PIXELS).step_by(S::F32_LANES) {
            let hit = splat.hit(simd, lane, offset_px);
            let at = block * BLOCK_PIXELS + lane;
            let pixels = at..at + S::F32_LANES;
            let before = Wide::load(simd, &self.channels[TRANSMITTANCE][pixels.clone()]);
            let after = before - hit.alpha * before;
            let goes_on = before.constant(f64::from(MIN_TRANSMITTANCE)).lt(after);
            let weight = before.zero().replace(before.and(hit.seen, goes_on), hit.alpha * before);
            for i in 0..TRANSMITTANCE {
                let channel = &mut self.channels[i][pixels.clone()];
                weight.mul_add(splat.values[i], Wide::load(simd, channel)).store(channel);
            }
            // A pixel that has ended is negative, so that it never goes on.
            let next = (-before.abs()).replace(goes_on, after);
            any_ended |= next.any(next.and(hit.seen, next.lt(next.zero())));
            before.replace(hit.seen, next).store(&mut self.channels[TRANSMITTANCE][pixels]);
        }
        any_ended
    }
}

/// Splats fetched together, so that the cache misses of one do not wait for those of the other.
pub const BATCH: usize = 16;

/// Copies the splats of some pairs.
#[inline(always)]
pub fn fetch(sorted: &[Splat], entries: &[Entry], pairs: &[Pair], batch: &mut [Splat; BATCH]) {
    for (pair, splat) in pairs.iter().zip(batch) {
        *splat = sorted[entries[pair.entry as usize].splat as usize];
    }
}

/// Whether all pixels of a block have ended.
#[inline(always)]
pub fn block_has_ended<S: Simd>(simd: S, transmittance: &[f32; TILE_PIXELS], block: usize) -> bool {
    let mut any_goes_on = false;
    for lane in (0..BLOCK_PIXELS).step_by(S::F32_LANES) {
        let at = block * BLOCK_PIXELS + lane;
        let value = Wide::load(simd, &transmittance[at..at + S::F32_LANES]);
        any_goes_on |= value.any(value.zero().lt(value));
    }
    !any_goes_on
}

/// Corner of a block as seen from a splat's mean, px.
#[inline(always)]
pub fn block_offset_px(block: usize, corner_from_mean_px: [f32; 2]) -> [f32; 2] {
    let x = (block % BLOCKS_PER_SIDE * BLOCK_PX) as f32;
    let y = (block / BLOCKS_PER_SIDE * BLOCK_PX) as f32;
    [corner_from_mean_px[0] + x, corner_from_mean_px[1] + y]
}

/// A splat's numbers in all lanes.
pub struct SplatLanes<S: Simd> {
    conic: [Wide<S>; 3],
    log2_opacity: Wide<S>,
    /// Red, green, blue, depth.
    pub values: [Wide<S>; 4],
}

/// How a splat covers some pixels.
pub struct Hit<S: Simd> {
    /// Pixel minus mean, px.
    pub dx: Wide<S>,
    /// Pixel minus mean, px.
    pub dy: Wide<S>,
    /// Opacity at the pixel before the cap.
    pub uncapped: Wide<S>,
    /// Opacity at the pixel.
    pub alpha: Wide<S>,
    /// Whether alpha is large enough to be seen.
    pub seen: S::m32s,
}

impl<S: Simd> SplatLanes<S> {
    /// Spreads a splat.
    #[inline(always)]
    pub fn new(simd: S, splat: &Splat) -> Self {
        Self {
            conic: each!(i in 3 => Wide::splat(simd, splat.conic_log2[i])),
            log2_opacity: Wide::splat(simd, splat.log2_opacity),
            values: each!(i in 4 => Wide::splat(simd, if i < 3 { splat.color[i] } else { splat.depth_m })),
        }
    }

    /// `alpha = min(0.99, opacity exp(-q))` at the pixels of a block from `lane` on.
    #[inline(always)]
    pub fn hit(&self, simd: S, lane: usize, offset_px: [f32; 2]) -> Hit<S> {
        let dx = Wide::load(simd, &BLOCK_X_PX[lane..]) + Wide::splat(simd, offset_px[0]);
        let dy = Wide::load(simd, &BLOCK_Y_PX[lane..]) + Wide::splat(simd, offset_px[1]);
        let [xx, xy, yy] = self.conic;
        let along_x = xx.mul_add(dx, xy * dy);
        let log2_alpha = along_x.mul_add(dx, (yy * dy).mul_add(dy, self.log2_opacity));
        let uncapped = log2_alpha.max(dx.constant(MIN_LOG2_ALPHA)).exp2_in_range();
        let alpha = uncapped.min(dx.constant(f64::from(MAX_ALPHA)));
        Hit { dx, dy, uncapped, alpha, seen: dx.constant(f64::from(LOG2_MIN_ALPHA)).lt(log2_alpha) }
    }
}
