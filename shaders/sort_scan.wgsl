// Where each piece's keys begin within their digit, and how often each digit occurs. One invocation per digit.
@group(0) @binding(1) var<storage, read_write> digit_counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> digit_totals: array<u32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) d: u32) {
    var next = 0u;
    for (var piece = 0u; piece < SORT_PIECES; piece++) {
        let at = piece * DIGITS + d;
        let here = digit_counts[at];
        digit_counts[at] = next;
        next += here;
    }
    digit_totals[d] = next;
}
