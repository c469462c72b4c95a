// Unpacks the target, applies the exposure, and starts the gradients with the terms that look at one pixel.
// Every invocation takes each LOSS_PIECES-th pixel.
@group(0) @binding(1) var<storage, read> target_words: array<u32>;
@group(0) @binding(2) var<storage, read> target_depth: array<f32>;
@group(0) @binding(3) var<storage, read> planes: array<f32>;
@group(0) @binding(4) var<storage, read_write> target_planes: array<f32>;
@group(0) @binding(5) var<storage, read_write> exposed_planes: array<f32>;
@group(0) @binding(6) var<storage, read_write> upstream: array<f32>;
@group(0) @binding(7) var<storage, read_write> loss_sums: array<f32>;

// One channel of a pixel. No branch on a number of the view here: software Vulkan (Mesa 22.3) compiles such a kernel anew
// for every dispatch through wgpu, and keeps what it compiled.
fn target_channel(at: u32, channel: u32) -> f32 {
    let is_gray = view.target_kind == TARGET_GRAY8;
    let i = select(3u * at + channel, at, is_gray);
    let byte = f32((target_words[i / 4u] >> (8u * (i % 4u))) & 0xffu) * BYTE_SCALE;
    return select(byte, bitcast<f32>(target_words[i]), view.target_kind == TARGET_RGB_F32);
}

fn target_color(at: u32) -> vec3<f32> {
    return vec3<f32>(target_channel(at, 0u), target_channel(at, 1u), target_channel(at, 2u));
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = view.width * view.height;
    let color_scale = view.l1_weight / f32(3u * n);
    let depth_scale = view.depth_weight / max(view.confidence_sum, 1e-30);
    var absolute = 0.0;
    var square = 0.0;
    var depth = 0.0;
    for (var at = id.x; at < n; at += LOSS_PIECES) {
        let wanted = target_color(at);
        let drawn = vec3<f32>(planes[at], planes[n + at], planes[2u * n + at]);
        let exposed = view.gain.xyz * drawn + view.bias.xyz;
        let difference = exposed - wanted;
        let grad = color_scale * sign(difference);
        for (var i = 0u; i < 3u; i++) {
            target_planes[i * n + at] = wanted[i];
            exposed_planes[i * n + at] = exposed[i];
            upstream[i * n + at] = grad[i];
        }
        absolute += dot(abs(difference), vec3<f32>(1.0));
        square += dot(difference, difference);
        var grad_depth = 0.0;
        let confidence = select(0.0, target_depth[n + at], view.has_depth != 0u);
        if confidence > 0.0 {
            let depth_difference = planes[3u * n + at] - target_depth[at];
            grad_depth = depth_scale * confidence * sign(depth_difference);
            depth += confidence * abs(depth_difference);
        }
        upstream[3u * n + at] = grad_depth;
        upstream[4u * n + at] = 0.0;
    }
    loss_sums[SUM_ABSOLUTE * LOSS_PIECES + id.x] = absolute;
    loss_sums[SUM_SQUARE * LOSS_PIECES + id.x] = square;
    loss_sums[SUM_DEPTH * LOSS_PIECES + id.x] = depth;
    loss_sums[SUM_SSIM * LOSS_PIECES + id.x] = 0.0;
}
