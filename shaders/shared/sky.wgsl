// Angle of (x, y) from the x axis, rad in -pi..=pi.
fn angle_of(y: f32, x: f32) -> f32 {
    let ax = abs(x);
    let ay = abs(y);
    let ratio = min(ax, ay) / max(max(ax, ay), MIN_DIRECTION);
    let s = ratio * ratio;
    var sum = ATAN_COEFFICIENTS[0] * s + ATAN_COEFFICIENTS[1];
    sum = sum * s + ATAN_COEFFICIENTS[2];
    sum = sum * s + ATAN_COEFFICIENTS[3];
    sum = sum * s + ATAN_COEFFICIENTS[4];
    sum = sum * s + ATAN_COEFFICIENTS[5];
    sum = sum * s + ATAN_COEFFICIENTS[6];
    sum = sum * s + ATAN_COEFFICIENTS[7];
    var angle = sum * ratio;
    angle = select(angle, 0.5 * PI - angle, ax < ay);
    angle = select(angle, PI - angle, x < 0.0);
    return select(angle, -angle, y < 0.0);
}

// Where a pixel falls between four texels of a table.
struct Corners {
    at: vec4<u32>,
    weight: vec4<f32>,
    // Column, shifted by one, and row.
    place: vec2<f32>,
}

// Ray in map axes, not normalised.
fn ray_of(x_px: f32, y_px: f32) -> vec3<f32> {
    return view.ray_corner.xyz + x_px * view.ray_right.xyz + y_px * view.ray_down.xyz;
}

fn corners_of(x_px: f32, y_px: f32) -> Corners {
    let d = ray_of(x_px, y_px);
    let azimuth = angle_of(d.x, d.z);
    let elevation = angle_of(-d.y, sqrt(d.x * d.x + d.z * d.z));
    let turn = select(azimuth, azimuth + TAU, azimuth < 0.0);
    let rows_per_rad = f32(BACKGROUND_ROWS) / (BACKGROUND_MAX_ELEVATION_RAD - BACKGROUND_MIN_ELEVATION_RAD);
    // Shifted by one so that it is never negative.
    let column = turn * (f32(BACKGROUND_COLUMNS) / TAU) + 0.5;
    let row = clamp((elevation - BACKGROUND_MIN_ELEVATION_RAD) * rows_per_rad - 0.5, 0.0, f32(BACKGROUND_ROWS) - 1.0);
    let left = u32(column);
    let low = u32(row);
    let fx = column - f32(left);
    let fy = row - f32(low);
    let columns = vec2<u32>((left + BACKGROUND_COLUMNS - 1u) % BACKGROUND_COLUMNS, left % BACKGROUND_COLUMNS);
    let rows = vec2<u32>(min(low, BACKGROUND_ROWS - 1u), min(low + 1u, BACKGROUND_ROWS - 1u)) * BACKGROUND_COLUMNS;
    return Corners(
        vec4<u32>(rows.xx + columns, rows.yy + columns),
        vec4<f32>((1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy),
        vec2<f32>(column, row),
    );
}
