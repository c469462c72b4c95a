// Where each workgroup's candidates begin, how many there are, and the workgroups that they need.
@group(0) @binding(1) var<storage, read_write> group_totals: array<u32>;
@group(0) @binding(2) var<storage, read_write> counters: Counters;
@group(0) @binding(3) var<storage, read_write> dispatch: IndirectGroups;

@compute @workgroup_size(GROUP)
fn main(@builtin(local_invocation_index) lane: u32) {
    let needed = scan_in_place(lane, (view.n_slots + GROUP - 1u) / GROUP);
    if lane == 0u {
        let n = min(needed, view.candidate_capacity);
        counters.candidates_needed = needed;
        counters.candidates = n;
        dispatch.candidates_x = (n + GROUP - 1u) / GROUP;
        dispatch.candidates_y = 1u;
        dispatch.candidates_z = 1u;
    }
}

// Exclusive sums of the first `n` totals, each invocation over one piece; returns the sum of all.
fn scan_in_place(lane: u32, n: u32) -> u32 {
    let piece = (n + GROUP - 1u) / GROUP;
    let first = min(lane * piece, n);
    let end = min(first + piece, n);
    var total = 0u;
    for (var i = first; i < end; i++) {
        total += group_totals[i];
    }
    var next = exclusive_sum(lane, total);
    for (var i = first; i < end; i++) {
        let here = group_totals[i];
        group_totals[i] = next;
        next += here;
    }
    return scan_sums[GROUP - 1u];
}
