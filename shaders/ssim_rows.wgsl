// Row sums of x, y, xx, yy, xy over the windows of one channel (Wang et al. 2004). Each invocation takes every
// LOSS_PIECES-th strip.
@group(0) @binding(1) var<storage, read> channel: u32;
@group(0) @binding(2) var<storage, read> exposed_planes: array<f32>;
@group(0) @binding(3) var<storage, read> target_planes: array<f32>;
@group(0) @binding(4) var<storage, read_write> window_sums: array<f32>;

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if view.ssim_weight == 0.0 {
        return;
    }
    let n = view.width * view.height;
    for (var i = id.x; i < n_strips(); i += LOSS_PIECES) {
        let s = strip_of(i);
        var sum_x = vec4<f32>();
        var sum_y = vec4<f32>();
        var sum_xx = vec4<f32>();
        var sum_yy = vec4<f32>();
        var sum_xy = vec4<f32>();
        for (var tap = 0u; tap < TAPS; tap++) {
            let at = tap_of(s, tap);
            if at < n {
                let x = exposed_planes[channel * n + at];
                let y = target_planes[channel * n + at];
                let weight = weights_of(tap);
                let wx = weight * x;
                let wy = weight * y;
                sum_x += wx;
                sum_y += wy;
                sum_xx += wx * x;
                sum_yy += wy * y;
                sum_xy += wx * y;
            }
        }
        for (var j = 0u; j < STRIP; j++) {
            let at = pixel_of(s, j);
            if at < n {
                window_sums[at] = sum_x[j];
                window_sums[n + at] = sum_y[j];
                window_sums[2u * n + at] = sum_xx[j];
                window_sums[3u * n + at] = sum_yy[j];
                window_sums[4u * n + at] = sum_xy[j];
            }
        }
    }
}
