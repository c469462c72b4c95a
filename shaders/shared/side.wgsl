// Cosine of the angle between the rays to an anchor, which is `at` in the camera's frame, from its keyframe and from the camera.
fn side_cosine(placement: KeyframeBlock, at: vec3<f32>) -> f32 {
    let seen = at - vec3<f32>(placement.row_x.w, placement.row_y.w, placement.row_z.w);
    let lengths = length(at) * length(seen);
    // What is where one of the two is has no sides.
    return select(1.0, dot(at, seen) / max(lengths, 1e-30), lengths > 0.0);
}

// How much of its opacity an anchor keeps by that cosine.
fn side_opacity(cosine: f32) -> f32 {
    return clamp(0.5 + 0.5 * (cosine - SIDE_BORDER_COSINE) / SIDE_FADE_COSINE, 0.0, 1.0);
}

// Change of `side_opacity` with the cosine.
fn side_opacity_slope(cosine: f32) -> f32 {
    return select(0.0, 0.5 / SIDE_FADE_COSINE, abs(cosine - SIDE_BORDER_COSINE) < SIDE_FADE_COSINE);
}

// Share of its opacity that an anchor keeps at its distance from the camera and on its side.
fn visibility_of(anchor: DeviceAnchor, placement: KeyframeBlock) -> f32 {
    let at = in_camera(placement, position_of(anchor));
    return band_opacity(level_of(anchor), length(at)) * side_opacity(side_cosine(placement, at));
}
