// Row sums of the slopes of one channel, collected at every pixel: a window sum is its own adjoint. Each invocation
// takes every LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> channel: u32;
@group(0) @binding(2) var<storage, read> exposed_planes: array<f32>;
@group(0) @binding(3) var<storage, read> target_planes: array<f32>;
@group(0) @binding(4) var<storage, read> window_sums: array<f32>;
@group(0) @binding(5) var<storage, read_write> upstream: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if view.ssim_weight == 0.0 {
        return;
    }
    let n = view.width * view.height;
    let scale = -view.ssim_weight / f32(3u * n);
    for (var i = id.x; i < n_strips(); i += LOSS_PIECES) {
        let s = strip_of(i);
        var by_x = vec4<f32>();
        var by_xx = vec4<f32>();
        var by_xy = vec4<f32>();
        for (var tap = 0u; tap < TAPS; tap++) {
            let at = tap_of(s, tap);
            if at < n {
                let weight = weights_of(tap);
                by_x += weight * window_sums[at];
                by_xx += weight * window_sums[n + at];
                by_xy += weight * window_sums[2u * n + at];
            }
        }
        for (var j = 0u; j < STRIP; j++) {
            let at = pixel_of(s, j);
            if at < n {
                let x = exposed_planes[channel * n + at];
                let y = target_planes[channel * n + at];
                let by_pixel = by_x[j] + 2.0 * x * by_xx[j] + y * by_xy[j];
                upstream[channel * n + at] += scale * by_pixel;
            }
        }
    }
}
