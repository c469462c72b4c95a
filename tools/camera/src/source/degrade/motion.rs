//! Blur of an exposure that is long for the motion of the image.

use super::Picture;

/// Way of a point during the exposure of a fast turn, over the width.
const TURN_PER_WIDTH: f32 = 0.02;
/// Way of a point during the exposure of fast driving, over its distance from the centre.
const ZOOM_RATIO: f32 = 0.06;
/// Points of that way that are averaged.
const ZOOM_TAPS: usize = 16;

/// Average along the rows; the border pixel goes on beyond the border.
pub fn blur(picture: &mut Picture<'_>, sharp: &mut [u8]) {
    sharp.copy_from_slice(picture.pixels);
    let (width, channels) = (picture.width, picture.channels);
    let half = ((0.5 * TURN_PER_WIDTH * width as f32) as usize).max(1);
    let length = (2 * half + 1) as u32;
    let row_bytes = width * channels;
    for (row, out) in sharp.chunks_exact(row_bytes).zip(picture.pixels.chunks_exact_mut(row_bytes)) {
        for channel in 0..channels {
            let at = |x: usize| u32::from(row[x.min(width - 1) * channels + channel]);
            let mut sum: u32 = half as u32 * at(0) + (0..=half).map(at).sum::<u32>();
            for x in 0..width {
                out[x * channels + channel] = ((sum + length / 2) / length) as u8;
                sum = sum + at(x + half + 1) - at(x.saturating_sub(half));
            }
        }
    }
}

/// Average along the way to the image's centre, where the vehicle drives to.
pub fn zoom_blur(picture: &mut Picture<'_>, sharp: &mut [u8]) {
    sharp.copy_from_slice(picture.pixels);
    let (width, channels) = (picture.width, picture.channels);
    let (center_x, center_y) = (0.5 * width as f32, 0.5 * picture.height as f32);
    for (i, out) in picture.pixels.chunks_exact_mut(channels).enumerate() {
        let (dx, dy) = ((i % width) as f32 + 0.5 - center_x, (i / width) as f32 + 0.5 - center_y);
        let mut sums = [0_u32; 3];
        for tap in 0..ZOOM_TAPS {
            let shrink = 1.0 - ZOOM_RATIO * tap as f32 / (ZOOM_TAPS - 1) as f32;
            let from = (center_y + shrink * dy) as usize * width + (center_x + shrink * dx) as usize;
            let pixel = &sharp[from * channels..][..channels];
            sums.iter_mut().zip(pixel).for_each(|(sum, byte)| *sum += u32::from(*byte));
        }
        out.iter_mut().zip(sums).for_each(|(byte, sum)| *byte = (sum / ZOOM_TAPS as u32) as u8);
    }
}
