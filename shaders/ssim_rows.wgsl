// Row sums of x, y, xx, yy, xy over the windows of one channel (Wang et al. 2004). Each invocation takes every
// LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> channel: u32;
@group(0) @binding(2) var<storage, read> exposed_planes: array<f32>;
@group(0) @binding(3) var<storage, read> target_planes: array<f32>;
@group(0) @binding(4) var<storage, read_write> window_sums: array<f32>;

// Window sums of four pixels.
struct Sums {
    sum_x: vec4<f32>,
    sum_y: vec4<f32>,
    sum_xx: vec4<f32>,
    sum_yy: vec4<f32>,
    sum_xy: vec4<f32>,
}

fn add_tap(s: Strip, tap: u32, weight: vec4<f32>, sums: ptr<function, Sums>) {
    let n = view.width * view.height;
    let at = tap_of(s, tap);
    if at < n {
        let x = exposed_planes[channel * n + at];
        let y = target_planes[channel * n + at];
        let wx = weight * x;
        let wy = weight * y;
        (*sums).sum_x += wx;
        (*sums).sum_y += wy;
        (*sums).sum_xx += wx * x;
        (*sums).sum_yy += wy * y;
        (*sums).sum_xy += wx * y;
    }
}

// One pixel of a strip. Its number is written out where this is called: a vector that is indexed lies in memory.
fn store(s: Strip, j: u32, x: f32, y: f32, xx: f32, yy: f32, xy: f32) {
    let n = view.width * view.height;
    let at = pixel_of(s, j);
    if at < n {
        window_sums[at] = x;
        window_sums[n + at] = y;
        window_sums[2u * n + at] = xx;
        window_sums[3u * n + at] = yy;
        window_sums[4u * n + at] = xy;
    }
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let end = end_of_strips();
    for (var i = id.x; i < end; i += LOSS_PIECES) {
        let s = strip_of(i);
        let sums = sum_windows(s);
        store(s, 0u, sums.sum_x.x, sums.sum_y.x, sums.sum_xx.x, sums.sum_yy.x, sums.sum_xy.x);
        store(s, 1u, sums.sum_x.y, sums.sum_y.y, sums.sum_xx.y, sums.sum_yy.y, sums.sum_xy.y);
        store(s, 2u, sums.sum_x.z, sums.sum_y.z, sums.sum_xx.z, sums.sum_yy.z, sums.sum_xy.z);
        store(s, 3u, sums.sum_x.w, sums.sum_y.w, sums.sum_xx.w, sums.sum_yy.w, sums.sum_xy.w);
    }
}
