// Whole units of a texel's sum stay below this.
const TEXEL_LIMIT: f32 = 1073741824.0;
// Parts of a unit: 2^24 pixels add up to less than 2^32 of them.
const TEXEL_FRACTION: f32 = 256.0;

// Units per unit of gradient; 0 where there is nothing to add up.
fn texel_scale(bounds: Bounds) -> f32 {
    let largest = bitcast<f32>(bounds.color);
    let scale = TEXEL_LIMIT / (f32(view.width * view.height) * largest);
    return select(0.0, scale, largest > 1e-28 && largest < 1e28);
}
