// Column sums, the similarity of one channel and its slopes. Each invocation takes every LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> window_sums: array<f32>;
@group(0) @binding(2) var<storage, read_write> window_slopes: array<f32>;
@group(0) @binding(3) var<storage, read_write> loss_sums: array<f32>;

struct Similarity {
    value: vec4<f32>,
    // Derivatives with respect to the window sums of x, xx, xy.
    by_mean: vec4<f32>,
    by_variance: vec4<f32>,
    by_covariance: vec4<f32>,
}

fn similarity(mean_x: vec4<f32>, mean_y: vec4<f32>, xx: vec4<f32>, yy: vec4<f32>, xy: vec4<f32>) -> Similarity {
    let covariance = xy - mean_x * mean_y;
    let variances = (xx - mean_x * mean_x) + (yy - mean_y * mean_y);
    let mean_top = 2.0 * mean_x * mean_y + SSIM_C1;
    let mean_bottom = mean_x * mean_x + mean_y * mean_y + SSIM_C1;
    let variance_top = 2.0 * covariance + SSIM_C2;
    let variance_bottom = variances + SSIM_C2;
    let inverse = 1.0 / (mean_bottom * variance_bottom);
    let value = mean_top * variance_top * inverse;
    let by_covariance = 2.0 * mean_top * inverse;
    let by_variance = -value / variance_bottom;
    let by_mean = 2.0 * mean_y * variance_top * inverse - 2.0 * mean_x * value / mean_bottom;
    // The variance and covariance contain the mean as well.
    return Similarity(
        value,
        by_mean - 2.0 * mean_x * by_variance - mean_y * by_covariance,
        by_variance,
        by_covariance,
    );
}

// Window sums of four pixels.
struct Sums {
    mean_x: vec4<f32>,
    mean_y: vec4<f32>,
    xx: vec4<f32>,
    yy: vec4<f32>,
    xy: vec4<f32>,
}

fn add_tap(s: Strip, tap: u32, weight: vec4<f32>, sums: ptr<function, Sums>) {
    let n = view.width * view.height;
    let at = tap_of(s, tap);
    if at < n {
        (*sums).mean_x += weight * window_sums[at];
        (*sums).mean_y += weight * window_sums[n + at];
        (*sums).xx += weight * window_sums[2u * n + at];
        (*sums).yy += weight * window_sums[3u * n + at];
        (*sums).xy += weight * window_sums[4u * n + at];
    }
}

// One pixel of a strip. Its number is written out where this is called: a vector that is indexed lies in memory.
fn store(s: Strip, j: u32, value: f32, by_mean: f32, by_variance: f32, by_covariance: f32) -> f32 {
    let n = view.width * view.height;
    let at = pixel_of(s, j);
    if at >= n {
        return 0.0;
    }
    window_slopes[at] = by_mean;
    window_slopes[n + at] = by_variance;
    window_slopes[2u * n + at] = by_covariance;
    return value;
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    var total = 0.0;
    let end = end_of_strips();
    for (var i = id.x; i < end; i += LOSS_PIECES) {
        let s = strip_of(i);
        let sums = sum_windows(s);
        let found = similarity(sums.mean_x, sums.mean_y, sums.xx, sums.yy, sums.xy);
        total += store(s, 0u, found.value.x, found.by_mean.x, found.by_variance.x, found.by_covariance.x);
        total += store(s, 1u, found.value.y, found.by_mean.y, found.by_variance.y, found.by_covariance.y);
        total += store(s, 2u, found.value.z, found.by_mean.z, found.by_variance.z, found.by_covariance.z);
        total += store(s, 3u, found.value.w, found.by_mean.w, found.by_variance.w, found.by_covariance.w);
    }
    loss_sums[SUM_SSIM * LOSS_PIECES + id.x] += total;
}
