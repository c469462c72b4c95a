// How many entries of each piece of a row meet a tile. One workgroup per tile, one invocation per piece.
@group(0) @binding(1) var<storage, read> entry_starts: array<u32>;
@group(0) @binding(2) var<storage, read> entries: array<Entry>;
@group(0) @binding(3) var<storage, read_write> pair_offsets: array<u32>;
@group(0) @binding(4) var<storage, read_write> tile_starts: array<u32>;

@compute @workgroup_size(TILE_GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let row = group.x / view.tile_columns;
    let column = group.x % view.tile_columns;
    let row_end = entry_starts[row + 1u];
    let len = (row_end - entry_starts[row] + TILE_GROUP - 1u) / TILE_GROUP;
    let first = entry_starts[row] + lane * len;
    let end = min(first + len, row_end);
    var total = 0u;
    for (var i = first; i < end; i++) {
        total += select(0u, 1u, meets_tile(entries[i], column));
    }
    pair_offsets[group.x * TILE_GROUP + lane] = exclusive_sum(lane, total);
    if lane == 0u {
        tile_starts[group.x] = scan_sums[TILE_GROUP - 1u];
    }
}
