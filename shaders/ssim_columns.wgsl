// Column sums of the slopes of one channel. Each invocation takes every LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> window_slopes: array<f32>;
@group(0) @binding(2) var<storage, read_write> window_sums: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if view.ssim_weight == 0.0 {
        return;
    }
    let n = view.width * view.height;
    for (var i = id.x; i < n_strips(); i += LOSS_PIECES) {
        let s = strip_of(i);
        var by_mean = vec4<f32>();
        var by_variance = vec4<f32>();
        var by_covariance = vec4<f32>();
        for (var tap = 0u; tap < TAPS; tap++) {
            let at = tap_of(s, tap);
            if at < n {
                let weight = weights_of(tap);
                by_mean += weight * window_slopes[at];
                by_variance += weight * window_slopes[n + at];
                by_covariance += weight * window_slopes[2u * n + at];
            }
        }
        for (var j = 0u; j < STRIP; j++) {
            let at = pixel_of(s, j);
            if at < n {
                window_sums[at] = by_mean[j];
                window_sums[n + at] = by_variance[j];
                window_sums[2u * n + at] = by_covariance[j];
            }
        }
    }
}
