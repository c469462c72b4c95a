// Share of the coarser level across the border that starts at `border_m`.
fn border_weight(border_m: f32, distance_m: f32) -> f32 {
    let half_width_m = border_m * BAND_OVERLAP_RATIO;
    return clamp(0.5 + 0.5 * (distance_m - border_m) / half_width_m, 0.0, 1.0);
}

// How much of its opacity an anchor of `level` keeps when seen from `distance_m`.
fn band_opacity(level: u32, distance_m: f32) -> f32 {
    var starts_m = BAND_STARTS_M;
    if level >= N_LEVELS {
        return 0.0;
    }
    var rises = 1.0;
    if level > 0u {
        rises = border_weight(starts_m[level], distance_m);
    }
    var falls = 0.0;
    if level + 1u < N_LEVELS {
        falls = border_weight(starts_m[level + 1u], distance_m);
    }
    return rises * (1.0 - falls);
}

// Change of `border_weight` per metre.
fn border_slope(border_m: f32, distance_m: f32) -> f32 {
    let half_width_m = border_m * BAND_OVERLAP_RATIO;
    return select(0.0, 0.5 / half_width_m, abs(distance_m - border_m) < half_width_m);
}

// Change of `band_opacity` per metre of distance.
fn band_opacity_slope(level: u32, distance_m: f32) -> f32 {
    var starts_m = BAND_STARTS_M;
    var rises = 1.0;
    var rise = 0.0;
    if level > 0u && level < N_LEVELS {
        rises = border_weight(starts_m[level], distance_m);
        rise = border_slope(starts_m[level], distance_m);
    }
    var falls = 0.0;
    var fall = 0.0;
    if level + 1u < N_LEVELS {
        falls = border_weight(starts_m[level + 1u], distance_m);
        fall = border_slope(starts_m[level + 1u], distance_m);
    }
    return rise * (1.0 - falls) - rises * fall;
}
