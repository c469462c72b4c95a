// Four pixels side by side.
struct Strip {
    left: u32,
    row: u32,
}

fn strips_per_row() -> u32 {
    return (view.width + STRIP - 1u) / STRIP;
}

fn n_strips() -> u32 {
    return strips_per_row() * view.height;
}

fn strip_of(i: u32) -> Strip {
    return Strip(i % strips_per_row() * STRIP, i / strips_per_row());
}

// Pixel of a tap; outside the picture the number of its pixels.
fn tap_of(s: Strip, tap: u32) -> u32 {
    // Columns left of the picture wrap around to large numbers.
    let column = s.left + tap - SSIM_RADIUS;
    return select(view.width * view.height, s.row * view.width + column, column < view.width);
}

fn pixel_of(s: Strip, i: u32) -> u32 {
    return tap_of(s, i + SSIM_RADIUS);
}
