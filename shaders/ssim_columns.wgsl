// Column sums of the slopes of one channel. Each invocation takes every LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> window_slopes: array<f32>;
@group(0) @binding(2) var<storage, read_write> window_sums: array<f32>;

// Window sums of four pixels.
struct Sums {
    by_mean: vec4<f32>,
    by_variance: vec4<f32>,
    by_covariance: vec4<f32>,
}

fn add_tap(s: Strip, tap: u32, weight: vec4<f32>, sums: ptr<function, Sums>) {
    let n = view.width * view.height;
    let at = tap_of(s, tap);
    if at < n {
        (*sums).by_mean += weight * window_slopes[at];
        (*sums).by_variance += weight * window_slopes[n + at];
        (*sums).by_covariance += weight * window_slopes[2u * n + at];
    }
}

// One pixel of a strip. Its number is written out where this is called: a vector that is indexed lies in memory.
fn store(s: Strip, j: u32, by_mean: f32, by_variance: f32, by_covariance: f32) {
    let n = view.width * view.height;
    let at = pixel_of(s, j);
    if at < n {
        window_sums[at] = by_mean;
        window_sums[n + at] = by_variance;
        window_sums[2u * n + at] = by_covariance;
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let end = end_of_strips();
    for (var i = id.x; i < end; i += LOSS_PIECES) {
        let s = strip_of(i);
        let sums = sum_windows(s);
        store(s, 0u, sums.by_mean.x, sums.by_variance.x, sums.by_covariance.x);
        store(s, 1u, sums.by_mean.y, sums.by_variance.y, sums.by_covariance.y);
        store(s, 2u, sums.by_mean.z, sums.by_variance.z, sums.by_covariance.z);
        store(s, 3u, sums.by_mean.w, sums.by_variance.w, sums.by_covariance.w);
    }
}
