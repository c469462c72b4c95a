// Where each piece's keys begin within their digit, and how often each digit occurs. One workgroup per digit.
@group(0) @binding(1) var<storage, read_write> digit_counts: array<u32>;
@group(0) @binding(2) var<storage, read_write> digit_totals: array<u32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32, @builtin(workgroup_id) group: vec3<u32>) {
    let len = SORT_PIECES / GROUP;
    let first = group.x * SORT_PIECES + lane * len;
    var total = 0u;
    for (var i = 0u; i < len; i++) {
        total += digit_counts[first + i];
    }
    var next = exclusive_sum(lane, total);
    for (var i = 0u; i < len; i++) {
        let here = digit_counts[first + i];
        digit_counts[first + i] = next;
        next += here;
    }
    if lane == 0u {
        digit_totals[group.x] = scan_sums[GROUP - 1u];
    }
}
