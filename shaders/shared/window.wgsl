// Gaussian weights of 11 pixels with standard deviation 1.5 px and sum 1, between zeros.
const WINDOW = array<f32, 17>(
    0.0, 0.0, 0.0,
    0.0010283801, 0.007598758, 0.036000773, 0.10936069, 0.21300554, 0.26601172, 0.21300554, 0.10936069, 0.036000773,
    0.007598758, 0.0010283801,
    0.0, 0.0, 0.0,
);
// Pixels from the middle of a window to its border.
const RADIUS: u32 = 5u;
// Windows of four neighbors together reach over this many pixels, of which each has its weights.
const STRIP: u32 = 4u;
const TAPS: u32 = 14u;

// Weights of the pixel `tap - RADIUS` in the windows around the pixels 0, 1, 2, 3.
fn weights_of(tap: u32) -> vec4<f32> {
    var window = WINDOW;
    return vec4<f32>(window[tap + 3u], window[tap + 2u], window[tap + 1u], window[tap]);
}
