//! How a picture is cut up: tiles of 16x16 px, each of 4x4 blocks of 4x4 px.
//!
//! A block is what SIMD works on (one vector of 16 lanes, two of 8, four of 4); a tile has one list of Gaussians,
//! in which each pair says by a bit mask which blocks it touches; a row of tiles is one job.

use crate::splat::kernel_constants as constants;

/// Side of a tile, px.
pub const TILE_PX: usize = constants::TILE_PX as usize;
/// Pixels of a tile.
pub const TILE_PIXELS: usize = TILE_PX * TILE_PX;
/// Side of a block, px.
pub const BLOCK_PX: usize = constants::BLOCK_PX as usize;
/// Pixels of a block.
pub const BLOCK_PIXELS: usize = BLOCK_PX * BLOCK_PX;
/// Blocks along the side of a tile.
pub const BLOCKS_PER_SIDE: usize = constants::BLOCKS_PER_SIDE as usize;
/// Blocks of a tile, one bit each.
pub const TILE_BLOCKS: usize = constants::TILE_BLOCKS as usize;
/// Most rows (or columns) of tiles.
pub const MAX_TILE_ROWS: usize = constants::MAX_TILE_ROWS as usize;

/// Size of a picture in pixels and tiles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Grid {
    /// Width, px.
    pub width: usize,
    /// Height, px.
    pub height: usize,
    /// Tiles side by side.
    pub columns: usize,
    /// Rows of tiles.
    pub rows: usize,
}

impl Grid {
    /// Tiles that cover a picture.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, columns: width.div_ceil(TILE_PX), rows: height.div_ceil(TILE_PX) }
    }

    /// Pixels of the picture.
    pub fn n_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Pixels of one row of tiles as stored row by row (the last row of tiles may hold fewer).
    pub fn tile_row_pixels(&self) -> usize {
        self.width * TILE_PX
    }
}

/// Position of a pixel of a tile in block order.
#[inline(always)]
pub fn pixel_in_block_order(x: usize, y: usize) -> usize {
    let block = (y / BLOCK_PX) * BLOCKS_PER_SIDE + x / BLOCK_PX;
    block * BLOCK_PIXELS + (y % BLOCK_PX) * BLOCK_PX + x % BLOCK_PX
}

/// Centres of a block's pixels from its left border, in block order, px.
pub const BLOCK_X_PX: [f32; BLOCK_PIXELS] = centers(true);
/// Centres of a block's pixels from its upper border, in block order, px.
pub const BLOCK_Y_PX: [f32; BLOCK_PIXELS] = centers(false);

const fn centers(along_x: bool) -> [f32; BLOCK_PIXELS] {
    let mut out = [0.0; BLOCK_PIXELS];
    let mut i = 0;
    while i < BLOCK_PIXELS {
        let step = if along_x { i % BLOCK_PX } else { i / BLOCK_PX };
        out[i] = step as f32 + 0.5;
        i += 1;
    }
    out
}

/// Copies a tile out of a plane stored row by row into block order; pixels beyond the border become 0.
#[inline(always)]
pub fn gather_tile(plane: &[f32], width: usize, tile_x: usize, tile: &mut [f32; TILE_PIXELS]) {
    let n_columns = TILE_PX.min(width - tile_x);
    if n_columns < TILE_PX || plane.len() < width * TILE_PX {
        tile.fill(0.0);
    }
    for (y, row) in plane.chunks(width).take(TILE_PX).enumerate() {
        let row = &row[tile_x..tile_x + n_columns];
        for (column, pixels) in row.chunks(BLOCK_PX).enumerate() {
            let at = pixel_in_block_order(column * BLOCK_PX, y);
            copy_block_row(pixels, &mut tile[at..at + BLOCK_PX]);
        }
    }
}

/// Inverse of [`gather_tile`]; what lies beyond the border is dropped.
#[inline(always)]
pub fn scatter_tile(tile: &[f32; TILE_PIXELS], width: usize, tile_x: usize, plane: &mut [f32]) {
    let n_columns = TILE_PX.min(width - tile_x);
    for (y, row) in plane.chunks_mut(width).take(TILE_PX).enumerate() {
        let row = &mut row[tile_x..tile_x + n_columns];
        for (column, pixels) in row.chunks_mut(BLOCK_PX).enumerate() {
            let at = pixel_in_block_order(column * BLOCK_PX, y);
            copy_block_row(&tile[at..at + BLOCK_PX], pixels);
        }
    }
}

/// Copies as much as both hold; the usual length is known, so that it is one instruction.
#[inline(always)]
fn copy_block_row(from: &[f32], to: &mut [f32]) {
    match (from.first_chunk::<BLOCK_PX>(), to.first_chunk_mut::<BLOCK_PX>()) {
        (Some(from), Some(to)) => *to = *from,
        _ => to.iter_mut().zip(from).for_each(|(to, from)| *to = *from),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tile_comes_back_where_it_was_and_nothing_else_is_touched() {
        for (width, height, tile_x) in [(16, 16, 0), (37, 16, 16), (37, 5, 32), (3, 2, 0)] {
            let plane: Vec<f32> = (0..width * height).map(|i| i as f32 + 1.0).collect();
            let mut tile = [f32::NAN; TILE_PIXELS];
            gather_tile(&plane, width, tile_x, &mut tile);
            assert!(tile.iter().all(|v| v.is_finite()), "{width}x{height}");
            let mut back = vec![-1.0; width * height];
            scatter_tile(&tile, width, tile_x, &mut back);
            for (i, (&got, &expected)) in back.iter().zip(&plane).enumerate() {
                let inside = (tile_x..tile_x + TILE_PX).contains(&(i % width));
                assert_eq!(got, if inside { expected } else { -1.0 }, "{width}x{height} pixel {i}");
            }
        }
    }

    #[test]
    fn block_order_is_a_permutation() {
        let mut seen = [false; TILE_PIXELS];
        for y in 0..TILE_PX {
            for x in 0..TILE_PX {
                seen[pixel_in_block_order(x, y)] = true;
            }
        }
        assert!(seen.iter().all(|&s| s));
        assert_eq!(pixel_in_block_order(5, 2), BLOCK_PIXELS + 2 * BLOCK_PX + 1);
    }
}
