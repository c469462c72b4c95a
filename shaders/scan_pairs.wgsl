// Where each tile begins in the list of pairs, and where the last one ends; what does not fit is cut off.
@group(0) @binding(1) var<storage, read_write> tile_starts: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: Counters;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32) {
    let n = view.tile_columns * view.tile_rows;
    let len = (n + GROUP - 1u) / GROUP;
    let first = min(lane * len, n);
    let end = min(first + len, n);
    var total = 0u;
    for (var i = first; i < end; i++) {
        total += tile_starts[i];
    }
    var next = exclusive_sum(lane, total);
    for (var i = first; i < end; i++) {
        let here = tile_starts[i];
        tile_starts[i] = min(next, view.pair_capacity);
        next += here;
    }
    if lane == 0u {
        let needed = scan_sums[GROUP - 1u];
        tile_starts[n] = min(needed, view.pair_capacity);
        counters.pairs_needed = needed;
    }
}
