// Gradients of the texels of the view's chunk row, and zero sums for the next view. One invocation per number.
@group(0) @binding(1) var<storage, read> bounds: Bounds;
@group(0) @binding(2) var<storage, read_write> texel_sums: array<i32>;
@group(0) @binding(3) var<storage, read_write> texel_grads: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let at = id.x;
    if at >= 3u * BACKGROUND_COLUMNS * BACKGROUND_ROWS {
        return;
    }
    let scale = texel_scale(bounds);
    let whole = f32(texel_sums[2u * at]);
    let rest = f32(bitcast<u32>(texel_sums[2u * at + 1u])) / TEXEL_FRACTION;
    texel_grads[at] = select(0.0, (whole + rest) / scale, scale > 0.0);
    texel_sums[2u * at] = 0;
    texel_sums[2u * at + 1u] = 0;
}
