// Numbers of every candidate as they are decoded from now on: what is stored. `decode_anchors` adds to them.
@group(0) @binding(1) var<storage, read> params: array<f32>;
@group(0) @binding(2) var<storage, read> candidates: array<u32>;
@group(0) @binding(3) var<storage, read> counters: Counters;
@group(0) @binding(4) var<storage, read_write> effective: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= counters.candidates {
        return;
    }
    let first_number = candidates[id.x] * N_PARAMS;
    for (var i = 0u; i < N_PARAMS; i++) {
        effective[i * view.candidate_capacity + id.x] = params[first_number + i];
    }
}
