// Gradients of the exposure, and those of the color carried through it. Every invocation takes each LOSS_PIECES-th
// pixel.
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read_write> upstream: array<f32>;
@group(0) @binding(3) var<storage, read_write> loss_sums: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = view.width * view.height;
    for (var i = 0u; i < 3u; i++) {
        var gain = 0.0;
        var bias = 0.0;
        for (var at = id.x; at < n; at += LOSS_PIECES) {
            let grad = upstream[i * n + at];
            gain += grad * planes[i * n + at];
            bias += grad;
            upstream[i * n + at] = grad * view.gain[i];
        }
        loss_sums[(SUM_GAIN + i) * LOSS_PIECES + id.x] = gain;
        loss_sums[(SUM_BIAS + i) * LOSS_PIECES + id.x] = bias;
    }
}
