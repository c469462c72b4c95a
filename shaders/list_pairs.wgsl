// Splats that meet each tile, by depth, with the blocks that they touch. One workgroup per tile, one invocation per
// piece of the row's entries.
@group(0) @binding(1) var<storage, read> splats: array<Splat>;
@group(0) @binding(2) var<storage, read> entry_starts: array<u32>;
@group(0) @binding(3) var<storage, read> entries: array<Entry>;
@group(0) @binding(4) var<storage, read> pair_offsets: array<u32>;
@group(0) @binding(5) var<storage, read> tile_starts: array<u32>;
@group(0) @binding(6) var<storage, read_write> pairs: array<Pair>;
@group(0) @binding(7) var<storage, read_write> counters: Counters;

// Bit mask of the blocks of a tile that a splat touches.
fn blocks_of_tile(splat: Splat, top: u32, left: u32) -> u32 {
    let ellipse = ellipse_of(splat);
    let first_px = splat.rows_px & 0xffffu;
    let last_px = splat.rows_px >> 16u;
    var blocks = 0u;
    for (var block_row = 0u; block_row < BLOCKS_PER_SIDE; block_row++) {
        let block_top = top + block_row * BLOCK_PX;
        let first = max(block_top, first_px);
        let last = min(block_top + BLOCK_PX - 1u, last_px);
        if first > last {
            continue;
        }
        let columns = columns_in(ellipse, first, last) - i32(left);
        let low = max(columns.x, 0);
        let high = min(columns.y, i32(TILE_PX) - 1);
        if low <= high {
            let bits = (2u << (u32(high) / BLOCK_PX)) - (1u << (u32(low) / BLOCK_PX));
            blocks |= bits << (block_row * BLOCKS_PER_SIDE);
        }
    }
    return blocks;
}

@compute @workgroup_size(TILE_GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let row = group.x / view.tile_columns;
    let column = group.x % view.tile_columns;
    let row_end = entry_starts[row + 1u];
    let len = (row_end - entry_starts[row] + TILE_GROUP - 1u) / TILE_GROUP;
    let first = entry_starts[row] + lane * len;
    let end = min(first + len, row_end);
    var at = tile_starts[group.x] + pair_offsets[group.x * TILE_GROUP + lane];
    var listed = 0u;
    var i = first;
    while at < view.pair_capacity {
        // The next entry that meets this tile: cheap, so that the rest, which is not, keeps all invocations busy.
        while i < end && !meets_tile(entries[i], column) {
            i++;
        }
        if i >= end {
            break;
        }
        let splat = entries[i].splat;
        i++;
        let blocks = blocks_of_tile(splats[splat], row * TILE_PX, column * TILE_PX);
        pairs[at] = Pair(splat, blocks);
        listed += select(0u, 1u, blocks != 0u);
        at++;
    }
    if listed != 0u {
        atomicAdd(&counters.pairs, listed);
    }
}
