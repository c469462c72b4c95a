// Where each row of tiles begins in the list of entries, and where the last one ends; what does not fit is cut off.
@group(0) @binding(1) var<storage, read_write> entry_starts: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: Counters;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32) {
    var total = 0u;
    if lane < view.tile_rows {
        total = entry_starts[lane];
    }
    let start = exclusive_sum(lane, total);
    let needed = scan_sums[GROUP - 1u];
    if lane < view.tile_rows {
        entry_starts[lane] = min(start, view.entry_capacity);
    }
    if lane == 0u {
        entry_starts[view.tile_rows] = min(needed, view.entry_capacity);
        counters.entries_needed = needed;
    }
}
