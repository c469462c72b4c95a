// Column sums of the slopes of one channel. Each invocation takes every LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> window_slopes: array<f32>;
@group(0) @binding(2) var<storage, read_write> window_sums: array<f32>;

// Window sums of four pixels.
struct Sums {
    by_mean: vec4<f32>,
    by_variance: vec4<f32>,
    by_covariance: vec4<f32>,
}

// Constant weights instead of a loop: a table that is indexed is copied for every pixel.
fn add_tap(s: Strip, tap: u32, weight: vec4<f32>, sums: ptr<function, Sums>) {
    let n = view.width * view.height;
    let at = tap_of(s, tap);
    if at < n {
        (*sums).by_mean += weight * window_slopes[at];
        (*sums).by_variance += weight * window_slopes[n + at];
        (*sums).by_covariance += weight * window_slopes[2u * n + at];
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if view.ssim_weight == 0.0 {
        return;
    }
    let n = view.width * view.height;
    for (var i = id.x; i < n_strips(); i += LOSS_PIECES) {
        let s = strip_of(i);
        var sums = Sums();
        add_tap(s, 0u, TAP_0, &sums);
        add_tap(s, 1u, TAP_1, &sums);
        add_tap(s, 2u, TAP_2, &sums);
        add_tap(s, 3u, TAP_3, &sums);
        add_tap(s, 4u, TAP_4, &sums);
        add_tap(s, 5u, TAP_5, &sums);
        add_tap(s, 6u, TAP_6, &sums);
        add_tap(s, 7u, TAP_7, &sums);
        add_tap(s, 8u, TAP_8, &sums);
        add_tap(s, 9u, TAP_9, &sums);
        add_tap(s, 10u, TAP_10, &sums);
        add_tap(s, 11u, TAP_11, &sums);
        add_tap(s, 12u, TAP_12, &sums);
        add_tap(s, 13u, TAP_13, &sums);
        for (var j = 0u; j < STRIP; j++) {
            let at = pixel_of(s, j);
            if at < n {
                window_sums[at] = sums.by_mean[j];
                window_sums[n + at] = sums.by_variance[j];
                window_sums[2u * n + at] = sums.by_covariance[j];
            }
        }
    }
}
