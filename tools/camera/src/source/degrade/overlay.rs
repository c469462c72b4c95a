//! What comes between the camera and the street.

use super::{Picture, Place};
use crate::noise::{hash_unit, smooth_noise};
use kilogs_core::math::Rng;

/// Pixels of the image per streak of rain.
const PIXELS_PER_STREAK: usize = 900;
/// Length of a streak over the image's height: shortest and longest.
const STREAK_PER_HEIGHT: (f32, f32) = (0.05, 0.2);
/// Slant of the streaks, columns per row: least and most.
const STREAK_SLANT: (f32, f32) = (0.05, 0.25);
/// Brightness of a streak and how much of what is behind it it hides.
const STREAK: (f32, f32) = (235.0, 0.65);

/// Share of width and height that the truck takes: half of the image.
const TRUCK_SIZE: (f32, f32) = (0.6, 0.84);
/// Left edge of the truck over the width, from the time when it is in view to the time when it leaves.
const TRUCK_DRIFT: (f32, f32) = (0.08, 0.32);
/// Share of the frames in which the truck comes, and as many in which it goes.
const TRUCK_COMES: f32 = 0.2;
/// Wavelengths of what is painted and dirty on the truck, over the image's width.
const TRUCK_WAVELENGTHS: [f32; 3] = [0.08, 0.02, 0.006];

/// Blobs on the lens.
const N_BLOBS: usize = 14;
/// Radius of a blob over the image's width: smallest and largest.
const BLOB_RADIUS: (f32, f32) = (0.012, 0.055);
/// Brightness of dirt, in steps: darkest and brightest.
const BLOB_GREY: (f32, f32) = (8.0, 50.0);
/// How much a blob hides in its middle.
const BLOB_OPACITY: f32 = 0.93;

/// Thin bright streaks.
pub fn rain(picture: &mut Picture<'_>, rng: &mut Rng) {
    let (width, height) = (picture.width, picture.height);
    let mut between = |(low, high): (f32, f32)| low + (high - low) * rng.unit_f32();
    for _ in 0..width * height / PIXELS_PER_STREAK {
        let (x, y) = (between((0.0, width as f32)), between((-0.2, 1.0)) * height as f32);
        let (length_px, slant) = (between(STREAK_PER_HEIGHT) * height as f32, between(STREAK_SLANT));
        for step in 0..length_px as usize {
            let (column, row) = (x + slant * step as f32, y + step as f32);
            if row >= 0.0 && (row as usize) < height && (column as usize) < width {
                picture.blend(column as usize, row as usize, [STREAK.0; 3], STREAK.1);
            }
        }
    }
}

/// A truck's side that comes from the left, drifts through the view and leaves to the right.
pub fn truck(picture: &mut Picture<'_>, place: Place, seed: u32) {
    let (width, height) = (picture.width as f32, picture.height as f32);
    let left_edge = truck_left_edge(place.progress()) * width;
    let top = 0.5 * (1.0 - TRUCK_SIZE.1) * height;
    let tint = [1, 2, 3].map(|channel| 70.0 + 110.0 * hash_unit(channel, 0, seed));
    for y in 0..(TRUCK_SIZE.1 * height) as usize {
        for x in 0..picture.width {
            let along = x as f32 - left_edge;
            if (0.0..TRUCK_SIZE.0 * width).contains(&along) {
                let painted: f32 = TRUCK_WAVELENGTHS
                    .iter()
                    .zip(0..)
                    .map(|(wavelength, octave)| {
                        let wavelength_px = (wavelength * width).max(2.0);
                        smooth_noise(along / wavelength_px, y as f32 / wavelength_px, seed.wrapping_add(octave))
                    })
                    .sum();
                picture.blend(x, top as usize + y, tint.map(|grey| grey * (1.0 + 0.35 * painted)), 1.0);
            }
        }
    }
}

/// Left edge of the truck over the width.
fn truck_left_edge(progress: f32) -> f32 {
    let (before, behind) = (progress / TRUCK_COMES, (1.0 - progress) / TRUCK_COMES);
    let (first, last) = TRUCK_DRIFT;
    if before < 1.0 {
        -TRUCK_SIZE.0 + (first + TRUCK_SIZE.0) * before
    } else if behind < 1.0 {
        1.0 - (1.0 - last) * behind
    } else {
        first + (last - first) * (progress - TRUCK_COMES) / (1.0 - 2.0 * TRUCK_COMES)
    }
}

/// Soft dark blobs; the same generator gives the same blobs.
pub fn dirt(picture: &mut Picture<'_>, rng: &mut Rng) {
    let (width, height) = (picture.width as f32, picture.height as f32);
    let mut between = |(low, high): (f32, f32)| low + (high - low) * rng.unit_f32();
    for _ in 0..N_BLOBS {
        let (x, y) = (between((0.0, width)), between((0.0, height)));
        let (radius_px, grey) = (between(BLOB_RADIUS) * width, between(BLOB_GREY));
        let rows = (y - radius_px).max(0.0) as usize..((y + radius_px).min(height - 1.0) as usize + 1);
        for row in rows {
            for column in (x - radius_px).max(0.0) as usize..((x + radius_px).min(width - 1.0) as usize + 1) {
                let distance = (column as f32 - x).hypot(row as f32 - y) / radius_px;
                // Flat in the middle, soft over the outer third.
                let cover = (3.0 * (1.0 - distance)).clamp(0.0, 1.0);
                picture.blend(column, row, [grey; 3], BLOB_OPACITY * cover);
            }
        }
    }
}

impl Picture<'_> {
    /// Lays `color` over a pixel; a grey image takes its mean.
    fn blend(&mut self, x: usize, y: usize, color: [f32; 3], opacity: f32) {
        let pixel = &mut self.pixels[(y * self.width + x) * self.channels..][..self.channels];
        let mean = color.iter().sum::<f32>() / 3.0;
        for (channel, byte) in pixel.iter_mut().enumerate() {
            let over = if self.channels == 1 { mean } else { color[channel] };
            let mixed = f32::from(*byte) + opacity * (over - f32::from(*byte));
            *byte = (mixed + 0.5).clamp(0.0, 255.0) as u8;
        }
    }
}
