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

// Constant weights instead of a loop: a table that is indexed is copied for every pixel.
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
                window_sums[at] = sums.sum_x[j];
                window_sums[n + at] = sums.sum_y[j];
                window_sums[2u * n + at] = sums.sum_xx[j];
                window_sums[3u * n + at] = sums.sum_yy[j];
                window_sums[4u * n + at] = sums.sum_xy[j];
            }
        }
    }
}
