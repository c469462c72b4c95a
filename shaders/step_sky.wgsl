// One Adam step of the background; colors stay in [0, 1]. One invocation per number.
@group(0) @binding(1) var<storage, read> texel_grads: array<f32>;
@group(0) @binding(2) var<storage, read_write> texels: array<f32>;
@group(0) @binding(3) var<storage, read_write> texel_first: array<f32>;
@group(0) @binding(4) var<storage, read_write> texel_second: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if id.x >= TEXEL_NUMBERS || view.background_rate <= 0.0 {
        return;
    }
    let at = 3u * view.first_texel + id.x;
    let grad = texel_grads[id.x];
    // A texel that no ray has met stays as it is.
    if grad == 0.0 && texel_second[at] == 0.0 {
        return;
    }
    let before = AdamNumber(texels[at], texel_first[at], texel_second[at]);
    let after = adam(before, grad, view.background_rate, bias_correction(f32(view.background_step)));
    texels[at] = clamp(after.value, 0.0, 1.0);
    texel_first[at] = after.first;
    texel_second[at] = after.second;
}
