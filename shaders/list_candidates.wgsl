// Gaussians that may be in view (`slot * k + i`), ascending. One invocation per slot.
@group(0) @binding(1) var<storage, read> visible_bits: array<u32>;
@group(0) @binding(2) var<storage, read> group_totals: array<u32>;
@group(0) @binding(3) var<storage, read_write> candidates: array<u32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(local_invocation_index) lane: u32,
        @builtin(workgroup_id) group: vec3<u32>) {
    var bits = 0u;
    if id.x < view.n_slots {
        bits = visible_bits[id.x];
    }
    var at = group_totals[group.x] + exclusive_sum(lane, countOneBits(bits));
    while bits != 0u && at < view.candidate_capacity {
        candidates[at] = id.x * view.k + firstTrailingBit(bits);
        bits &= bits - 1u;
        at++;
    }
}
