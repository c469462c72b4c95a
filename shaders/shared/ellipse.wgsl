// The border where a splat's alpha is the smallest that can be seen: with
// xx dx^2 + xy dx dy + yy dy^2 + reach = 0 a row dy spans slope dy -+ half sqrt(1 - (dy / height)^2), widest at
// dy = -+ lean.
struct Ellipse {
    mean_px: vec2<f32>,
    slope: f32,
    half_px: f32,
    lean_px: f32,
    inverse_height: f32,
}

fn ellipse_of(splat: Splat) -> Ellipse {
    return Ellipse(
        vec2<f32>(splat.mean_x, splat.mean_y),
        splat.slope,
        splat.half_px,
        -0.5 * splat.conic_xy / splat.conic_yy * splat.extent_x,
        1.0 / splat.extent_y,
    );
}

fn half_width_px(e: Ellipse, dy: f32) -> f32 {
    let relative = dy * e.inverse_height;
    return e.half_px * sqrt(max(1.0 - relative * relative, 0.0));
}

// First and last pixel column of the ellipse within the pixel rows first..=last; the first is larger when there is none.
fn columns_in(e: Ellipse, first: u32, last: u32) -> vec2<i32> {
    let low = f32(first) + 0.5 - e.mean_px.y;
    let high = f32(last) + 0.5 - e.mean_px.y;
    let leftmost = min(max(-e.lean_px, low), high);
    let rightmost = min(max(e.lean_px, low), high);
    let left = e.slope * leftmost - half_width_px(e, leftmost);
    let right = e.slope * rightmost + half_width_px(e, rightmost);
    return pixels_within(e.mean_px.x, left, right, view.width);
}
