// A Gaussian as it is blended.
struct Splat {
    mean_x: f32,
    mean_y: f32,
    log2_opacity: f32,
    depth_m: f32,
    // log2 alpha = xx dx^2 + xy dx dy + yy dy^2 + log2_opacity
    conic_xx: f32,
    conic_xy: f32,
    conic_yy: f32,
    // First and last pixel row of the box around the ellipse, 16 bits each.
    rows_px: u32,
    red: f32,
    green: f32,
    blue: f32,
    // First and last pixel column of that box.
    columns_px: u32,
    // Half width and height of that box, px.
    extent_x: f32,
    extent_y: f32,
    // Horizontal shift of the middle of a row of the ellipse, per px of dy.
    slope: f32,
    // Half length of the row through the mean, px.
    half_px: f32,
}

// First and last pixel of `size` whose centre lies in mean + low .. mean + high; the first is larger when there is none.
fn pixels_within(mean_px: f32, low_px: f32, high_px: f32, size: u32) -> vec2<i32> {
    let first = max(ceil(mean_px + low_px - 0.5 - BORDER_MARGIN_PX), 0.0);
    let last = min(floor(mean_px + high_px - 0.5 + BORDER_MARGIN_PX), f32(size) - 1.0);
    // Conversions of numbers that do not fit are undefined on some devices.
    return vec2<i32>(i32(clamp(first, 0.0, 65535.0)), i32(clamp(last, -1.0, 65535.0)));
}

// Columns of a candidate that does not meet the picture.
const NO_COLUMNS: u32 = 0xffffffffu;

fn is_visible(splat: Splat) -> bool {
    return splat.columns_px != NO_COLUMNS;
}
