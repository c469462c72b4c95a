//! Too little light, and too much.

use super::{Picture, Place};
use crate::source::add_noise;
use kilogs_core::math::Rng;

/// Frames in which a tunnel gets dark.
const ENTRY_FRAMES: u64 = 4;
/// Frames that the exposure needs to adapt to daylight behind a tunnel.
const EXIT_FRAMES: u64 = 6;
/// Light of a tunnel over daylight: 255 steps become nine.
const TUNNEL_GAIN: f32 = 0.035;
/// Black level that remains in a tunnel.
const TUNNEL_BLACK: f32 = 6.0;
/// Noise in a tunnel, in steps.
const TUNNEL_SIGMA: f64 = 1.2;
/// Gain of an exposure that is still that of the tunnel.
const EXIT_GAIN: f32 = 5.0;

/// Frames in which the sun comes and goes.
const GLARE_FADE_FRAMES: u64 = 3;
/// Gain and brightening of the whole image in the sun.
const GLARE: (f32, f32) = (2.2, 30.0);
/// Where the sun stands, over width and height, and the radius of its bloom over the width.
const SUN: (f32, f32, f32) = (0.62, 0.30, 0.18);
/// Brightness that the bloom adds at its centre, in steps.
const BLOOM: f32 = 260.0;

/// Standard deviation of heavy noise, in steps.
const HEAVY_SIGMA: f64 = 25.0;

/// Darkness with what noise the sensor has, and the exposure of the dark when daylight returns.
pub fn tunnel(picture: &mut Picture<'_>, place: Place, rng: &mut Rng) {
    let exit_frames = EXIT_FRAMES.min(place.n_frames() / 3);
    if place.left <= exit_frames {
        let gain = 1.0 + (EXIT_GAIN - 1.0) * place.left as f32 / exit_frames as f32;
        expose(picture, gain, 0.0);
        return;
    }
    let dark = ((place.since + 1) as f32 / ENTRY_FRAMES as f32).min(1.0);
    expose(picture, TUNNEL_GAIN.powf(dark), dark * TUNNEL_BLACK);
    add_noise(picture.pixels, f64::from(dark) * TUNNEL_SIGMA, rng);
}

/// The sun in the lens.
pub fn glare(picture: &mut Picture<'_>, place: Place) {
    let strength = place.fade(GLARE_FADE_FRAMES);
    expose(picture, 1.0 + strength * (GLARE.0 - 1.0), strength * GLARE.1);
    let (width, height) = (picture.width as f32, picture.height as f32);
    let (sun_x, sun_y, radius_px) = (SUN.0 * width, SUN.1 * height, SUN.2 * width);
    for (i, pixel) in picture.pixels.chunks_exact_mut(picture.channels).enumerate() {
        let (dx, dy) = ((i % picture.width) as f32 - sun_x, (i / picture.width) as f32 - sun_y);
        let bloom = strength * BLOOM / (1.0 + (dx * dx + dy * dy) / (radius_px * radius_px)).powi(2);
        pixel.iter_mut().for_each(|byte| *byte = (f32::from(*byte) + bloom).min(255.0) as u8);
    }
}

/// A sensor at the end of its gain.
pub fn noise(picture: &mut Picture<'_>, rng: &mut Rng) {
    add_noise(picture.pixels, HEAVY_SIGMA, rng);
}

/// Brightness times `gain` plus `offset`, saturated.
fn expose(picture: &mut Picture<'_>, gain: f32, offset: f32) {
    let mut table = [0; 256];
    for (byte, out) in table.iter_mut().enumerate() {
        *out = (byte as f32 * gain + offset + 0.5).clamp(0.0, 255.0) as u8;
    }
    picture.pixels.iter_mut().for_each(|byte| *byte = table[usize::from(*byte)]);
}
