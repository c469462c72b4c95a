// Moves every key behind the smaller digits and behind equal digits that came before. One invocation per piece.
@group(0) @binding(1) var<storage, read> digit: u32;
@group(0) @binding(2) var<storage, read> counters: Counters;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read> order: array<u32>;
@group(0) @binding(5) var<storage, read_write> digit_counts: array<u32>;
@group(0) @binding(6) var<storage, read> digit_totals: array<u32>;
@group(0) @binding(7) var<storage, read_write> next_keys: array<u32>;
@group(0) @binding(8) var<storage, read_write> next_order: array<u32>;

var<workgroup> digit_starts: array<u32, DIGITS>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32) {
    digit_starts[lane] = exclusive_sum(lane, digit_totals[lane]);
    workgroupBarrier();
    let piece = id.x;
    let n = counters.candidates;
    let len = (n + SORT_PIECES - 1u) / SORT_PIECES;
    let end = min((piece + 1u) * len, n);
    for (var i = piece * len; i < end; i++) {
        let key = keys[i];
        let d = (key >> (digit * DIGIT_BITS)) & (DIGITS - 1u);
        let at = digit_counts[piece * DIGITS + d];
        digit_counts[piece * DIGITS + d] = at + 1u;
        let to = digit_starts[d] + at;
        next_keys[to] = key;
        next_order[to] = order[i];
    }
}
