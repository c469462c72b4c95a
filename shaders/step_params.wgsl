// One Adam step of every visible Gaussian's stored numbers. `effective` holds gradients by now. An invocation per
// candidate.
@group(0) @binding(1) var<storage, read> counters: Counters;
@group(0) @binding(2) var<storage, read> candidates: array<u32>;
@group(0) @binding(3) var<storage, read> splats: array<Splat>;
@group(0) @binding(4) var<storage, read> effective: array<f32>;
@group(0) @binding(5) var<storage, read_write> params: array<f32>;
@group(0) @binding(6) var<storage, read_write> param_first: array<f32>;
@group(0) @binding(7) var<storage, read_write> param_second: array<f32>;
@group(0) @binding(8) var<storage, read_write> param_steps: array<u32>;

fn rate_of(i: u32) -> f32 {
    if i < FIRST_LOG_SCALE {
        return view.offset_rate;
    }
    if i < FIRST_ROTATION {
        return view.log_scale_rate;
    }
    if i < FIRST_OPACITY {
        return view.rotation_rate;
    }
    return select(view.color_rate, view.opacity_rate, i == FIRST_OPACITY);
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let c = id.x;
    if c >= counters.candidates {
        return;
    }
    if !is_visible(splats[c]) {
        return;
    }
    let gaussian = candidates[c];
    let steps = min(param_steps[gaussian] + 1u, ADAM_MAX_STEPS);
    param_steps[gaussian] = steps;
    let correction = bias_correction(f32(steps));
    for (var i = 0u; i < N_PARAMS; i++) {
        let at = gaussian * N_PARAMS + i;
        let before = AdamNumber(params[at], param_first[at], param_second[at]);
        let after = adam(before, effective[i * view.candidate_capacity + c], rate_of(i), correction);
        params[at] = after.value;
        param_first[at] = after.first;
        param_second[at] = after.second;
    }
}
