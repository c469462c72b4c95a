// How many splats of each piece of the depth order meet a row of tiles. One workgroup per row, one invocation per piece.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<Splat>;
@group(0) @binding(4) var<storage, read_write> entry_offsets: array<u32>;
@group(0) @binding(5) var<storage, read_write> entry_starts: array<u32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let top = group.x * TILE_PX;
    let n = counters.visible;
    let len = (n + GROUP - 1u) / GROUP;
    let end = min((lane + 1u) * len, n);
    var total = 0u;
    for (var i = lane * len; i < end; i++) {
        let rows = splats[order[i]].rows_px;
        total += select(0u, 1u, (rows >> 16u) >= top && (rows & 0xffffu) < top + TILE_PX);
    }
    entry_offsets[group.x * GROUP + lane] = exclusive_sum(lane, total);
    if lane == 0u {
        entry_starts[group.x] = scan_sums[GROUP - 1u];
    }
}
