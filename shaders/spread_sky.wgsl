// Spreads the gradient of every pixel's background over the four texels that it is mixed from, in fixed point of two
// limbs: whole units, and 256ths that are never negative. One invocation per pixel.
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read> upstream: array<f32>;
@group(0) @binding(3) var<storage, read> bounds: Bounds;
@group(0) @binding(4) var<storage, read_write> texel_sums: array<atomic<i32>>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = view.width * view.height;
    let at = id.x;
    if at >= n {
        return;
    }
    let scale = texel_scale(bounds);
    let corners = corners_of(f32(at % view.width) + 0.5, f32(at / view.width) + 0.5);
    let weight = corners.weight * (planes[4u * n + at] * scale);
    for (var channel = 0u; channel < 3u; channel++) {
        let grad = upstream[channel * n + at];
        for (var i = 0u; i < 4u; i++) {
            let value = clamp(weight[i] * grad, -TEXEL_LIMIT / f32(n), TEXEL_LIMIT / f32(n));
            let whole = floor(value);
            let rest = i32((value - whole) * TEXEL_FRACTION);
            let to = (corners.at[i] * 3u + channel) * 2u;
            if whole != 0.0 {
                atomicAdd(&texel_sums[to], i32(whole));
            }
            if rest != 0 {
                atomicAdd(&texel_sums[to + 1u], rest);
            }
        }
    }
}
