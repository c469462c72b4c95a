// Puts the background behind the picture. One invocation per pixel.
@group(0) @binding(1) var<storage, read> texels: array<f32>;
@group(0) @binding(2) var<storage, read_write> planes: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = view.width * view.height;
    let at = id.x;
    if at >= n {
        return;
    }
    let corners = corners_of(f32(at % view.width) + 0.5, f32(at / view.width) + 0.5);
    let weight = corners.weight * planes[4u * n + at];
    for (var channel = 0u; channel < 3u; channel++) {
        var sum = 0.0;
        for (var i = 0u; i < 4u; i++) {
            sum += weight[i] * texels[(view.first_texel + corners.at[i]) * 3u + channel];
        }
        planes[channel * n + at] += sum;
    }
}
