// Row sums of the slopes of one channel, collected at every pixel: a window sum is its own adjoint. Each invocation
// takes every LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> channel: u32;
@group(0) @binding(2) var<storage, read> exposed_planes: array<f32>;
@group(0) @binding(3) var<storage, read> target_planes: array<f32>;
@group(0) @binding(4) var<storage, read> window_sums: array<f32>;
@group(0) @binding(5) var<storage, read_write> upstream: array<f32>;

// Window sums of four pixels.
struct Sums {
    by_x: vec4<f32>,
    by_xx: vec4<f32>,
    by_xy: vec4<f32>,
}

fn add_tap(s: Strip, tap: u32, weight: vec4<f32>, sums: ptr<function, Sums>) {
    let n = view.width * view.height;
    let at = tap_of(s, tap);
    if at < n {
        (*sums).by_x += weight * window_sums[at];
        (*sums).by_xx += weight * window_sums[n + at];
        (*sums).by_xy += weight * window_sums[2u * n + at];
    }
}

// One pixel of a strip. Its number is written out where this is called: a vector that is indexed lies in memory.
fn collect(s: Strip, j: u32, by_x: f32, by_xx: f32, by_xy: f32) {
    let n = view.width * view.height;
    let at = pixel_of(s, j);
    if at < n {
        let scale = -view.ssim_weight / f32(3u * n);
        let x = exposed_planes[channel * n + at];
        let y = target_planes[channel * n + at];
        upstream[channel * n + at] += scale * (by_x + 2.0 * x * by_xx + y * by_xy);
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let end = end_of_strips();
    for (var i = id.x; i < end; i += LOSS_PIECES) {
        let s = strip_of(i);
        let sums = sum_windows(s);
        collect(s, 0u, sums.by_x.x, sums.by_xx.x, sums.by_xy.x);
        collect(s, 1u, sums.by_x.y, sums.by_xx.y, sums.by_xy.y);
        collect(s, 2u, sums.by_x.z, sums.by_xx.z, sums.by_xy.z);
        collect(s, 3u, sums.by_x.w, sums.by_xx.w, sums.by_xy.w);
    }
}
