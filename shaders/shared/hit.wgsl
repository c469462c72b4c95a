// How a splat covers the four pixels of a block's row.
struct Hit {
    // Pixel minus mean, px.
    dx: vec4<f32>,
    dy: f32,
    // Opacity at the pixels before the cap.
    uncapped: vec4<f32>,
    // Opacity at the pixels.
    alpha: vec4<f32>,
    // Whether alpha is large enough to be seen.
    seen: vec4<bool>,
}

fn hit_row(splat: Splat, dx: vec4<f32>, dy: f32) -> Hit {
    let along_x = splat.conic_xx * dx + splat.conic_xy * dy;
    let log2_alpha = along_x * dx + (splat.conic_yy * dy * dy + splat.log2_opacity);
    let uncapped = power_of_2(log2_alpha);
    return Hit(dx, dy, uncapped, min(uncapped, vec4<f32>(MAX_ALPHA)), log2_alpha > vec4<f32>(LOG2_MIN_ALPHA));
}

// The block of an invocation: 16 consecutive ones to a tile, row by row.
struct Block {
    tile: u32,
    // Its bit in a pair.
    bit: u32,
    // First pixel.
    left: u32,
    top: u32,
}

fn block_of(invocation: u32) -> Block {
    let tile = invocation / TILE_BLOCKS;
    let block = invocation % TILE_BLOCKS;
    return Block(
        tile,
        1u << block,
        (tile % view.tile_columns) * TILE_PX + (block % BLOCKS_PER_SIDE) * BLOCK_PX,
        (tile / view.tile_columns) * TILE_PX + (block / BLOCKS_PER_SIDE) * BLOCK_PX,
    );
}
