// Four pixels one below the other: neighbors in a workgroup are neighbors in the picture.
struct Strip {
    column: u32,
    top: u32,
}

fn n_strips() -> u32 {
    return view.width * ((view.height + STRIP - 1u) / STRIP);
}

fn strip_of(i: u32) -> Strip {
    return Strip(i % view.width, i / view.width * STRIP);
}

// Pixel of a tap; outside the picture the number of its pixels.
fn tap_of(s: Strip, tap: u32) -> u32 {
    // Rows above the picture wrap around to large numbers.
    let row = s.top + tap - SSIM_RADIUS;
    return select(view.width * view.height, row * view.width + s.column, row < view.height);
}

fn pixel_of(s: Strip, i: u32) -> u32 {
    return tap_of(s, i + SSIM_RADIUS);
}
