// How often each digit occurs in each piece of the list: counts[piece][digit]. One invocation per piece.
@group(0) @binding(1) var<storage, read> digit: u32;
@group(0) @binding(2) var<storage, read> counters: Counters;
@group(0) @binding(3) var<storage, read> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> digit_counts: array<u32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let piece = id.x;
    for (var d = 0u; d < DIGITS; d++) {
        digit_counts[piece * DIGITS + d] = 0u;
    }
    let n = counters.candidates;
    let len = (n + SORT_PIECES - 1u) / SORT_PIECES;
    let end = min((piece + 1u) * len, n);
    for (var i = piece * len; i < end; i++) {
        let d = (keys[i] >> (digit * DIGIT_BITS)) & (DIGITS - 1u);
        digit_counts[piece * DIGITS + d] += 1u;
    }
}
