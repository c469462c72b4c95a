// Sums of a splat's gradients over blocks, in fixed point: integers add up to the same in any order.

// Sums stay below this, so that they never wrap.
const FIXED_LIMIT: f32 = 1073741824.0;

// Parts of a unit that sums over many blocks keep in a second integer: their units are coarse.
const FIXED_FRACTION: f32 = 1024.0;
// Blocks from which on a splat's sums have that second integer.
const MANY_BLOCKS: f32 = 12.0;

// Blocks that a splat can touch.
fn n_blocks_of(splat: Splat) -> f32 {
    let columns = (splat.columns_px >> 16u) / BLOCK_PX - (splat.columns_px & 0xffffu) / BLOCK_PX + 1u;
    let rows = (splat.rows_px >> 16u) / BLOCK_PX - (splat.rows_px & 0xffffu) / BLOCK_PX + 1u;
    return f32(columns * rows);
}

// Factors of the moments, of the color and of the depth when a block's sum is at most its pixels times the bounds;
// 0 where there is nothing to add up.
fn fixed_scales(splat: Splat, bounds: Bounds) -> vec3<f32> {
    let largest = vec3<f32>(bitcast<f32>(bounds.value), bitcast<f32>(bounds.color), bitcast<f32>(bounds.depth));
    let per_block = f32(BLOCK_PX * BLOCK_PX) * n_blocks_of(splat);
    // A bound that is not a number or infinite is that of a loss that is: nothing is learnt from it.
    let usable = (largest > vec3<f32>(1e-28)) & (largest < vec3<f32>(1e28));
    return select(vec3<f32>(), FIXED_LIMIT / (per_block * largest), usable);
}

// How large a block's part of a splat's sum may be, and whether it has parts of units.
struct Limits {
    largest: f32,
    has_fraction: bool,
}

fn limits_of(splat: Splat) -> Limits {
    let n_blocks = n_blocks_of(splat);
    return Limits(FIXED_LIMIT / n_blocks, n_blocks >= MANY_BLOCKS);
}

// Coordinates in which the ellipse of a splat is the unit circle: s = (dx - slope dy) / half, t = dy / height. Moments
// in them are no larger than the total, and a needle's are as exact as a disc's.
struct Circle {
    slope: f32,
    per_half: f32,
    per_height: f32,
}

fn circle_of(splat: Splat) -> Circle {
    return Circle(
        splat.slope, 1.0 / max(splat.half_px, MIN_EXTENT_PX), 1.0 / max(splat.extent_y, MIN_EXTENT_PX),
    );
}
