// How the rays of the pixels would turn the sky: the sum of ray x dL/dray, map axes. Every invocation takes each
// LOSS_PIECES-th pixel.
@group(0) @binding(1) var<storage, read> planes: array<f32>;
@group(0) @binding(2) var<storage, read> upstream: array<f32>;
@group(0) @binding(3) var<storage, read> texels: array<f32>;
@group(0) @binding(4) var<storage, read_write> loss_sums: array<f32>;

fn value_at(texel: u32, grad: vec3<f32>) -> f32 {
    let at = (view.first_texel + texel) * 3u;
    return texels[at] * grad.x + texels[at + 1u] * grad.y + texels[at + 2u] * grad.z;
}

// ray x dL/dray. With h^2 = x^2 + z^2, the azimuth atan2(x, z) gives [-x y / h^2, 1, -y z / h^2], the elevation
// atan2(-y, h) gives [z / h, 0, -x / h]; the length of the ray does not matter.
fn torque_of(x_px: f32, y_px: f32, grad: vec3<f32>) -> vec3<f32> {
    let corners = corners_of(x_px, y_px);
    let between = fract(corners.place);
    let up_left = value_at(corners.at.x, grad);
    let up_right = value_at(corners.at.y, grad);
    let down_left = value_at(corners.at.z, grad);
    let down_right = value_at(corners.at.w, grad);
    let per_column = mix(up_right - up_left, down_right - down_left, between.y);
    // Below the table every ray sees the lowest row; above it both rows are the highest one.
    let per_row = select(0.0, mix(down_left - up_left, down_right - up_right, between.x), corners.place.y > 0.0);
    let by_azimuth = per_column * (f32(BACKGROUND_COLUMNS) / TAU);
    let by_elevation = per_row * (f32(BACKGROUND_ROWS) / (BACKGROUND_MAX_ELEVATION_RAD - BACKGROUND_MIN_ELEVATION_RAD));
    let ray = ray_of(x_px, y_px);
    let h = sqrt(ray.x * ray.x + ray.z * ray.z);
    return vec3<f32>(
        by_elevation * ray.z / h - by_azimuth * ray.x * ray.y / (h * h),
        by_azimuth,
        -by_elevation * ray.x / h - by_azimuth * ray.y * ray.z / (h * h),
    );
}

@compute @workgroup_size(GROUP)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    let n = view.width * view.height;
    var sum = vec3<f32>();
    for (var at = id.x; at < n; at += LOSS_PIECES) {
        let grad = vec3<f32>(upstream[at], upstream[n + at], upstream[2u * n + at]) * planes[4u * n + at];
        let torque = torque_of(f32(at % view.width) + 0.5, f32(at / view.width) + 0.5, grad);
        // A ray straight up or down has no azimuth; not a number fails this comparison.
        sum += select(vec3<f32>(), torque, abs(torque) < vec3<f32>(MAX_GRADIENT));
    }
    for (var i = 0u; i < 3u; i++) {
        loss_sums[(SUM_SKY_TURN + i) * LOSS_PIECES + id.x] = sum[i];
    }
}
