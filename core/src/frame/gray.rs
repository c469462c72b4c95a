//! Any pixel format to grey, in one pass over the bytes of the camera.

use super::PixelFormat;
use core::fmt;

/// Luma weights of red, green and blue in units of 2^-16; they sum to one.
///
/// Source: ITU-R BT.601-7, section 2.5.1 (0.299, 0.587, 0.114).
const LUMA_WEIGHTS: [u32; 3] = [19_595, 38_470, 7_471];

/// Input or output bytes do not match the size of the frame.
///
/// The header and its payload disagree: refuse the frame and count it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameBytesMismatch {
    /// Bytes handed in.
    pub bytes: usize,
    /// Bytes that format and size ask for.
    pub needed: usize,
}

impl fmt::Display for FrameBytesMismatch {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "frame has {} bytes, its format and size ask for {}", self.bytes, self.needed)
    }
}

impl core::error::Error for FrameBytesMismatch {}

/// Bytes of a packed frame of this format and size; `None` when the format cannot have that size
/// (odd sides of a subsampled format) or the product overflows.
pub fn frame_bytes(format: PixelFormat, width: usize, height: usize) -> Option<usize> {
    let n_pixels = width.checked_mul(height)?;
    match format {
        PixelFormat::Mono8 | PixelFormat::BayerRggb8 => Some(n_pixels),
        PixelFormat::Rgb8 | PixelFormat::Bgr8 => n_pixels.checked_mul(3),
        PixelFormat::Nv12 if width.is_multiple_of(2) && height.is_multiple_of(2) => n_pixels.checked_add(n_pixels / 2),
        PixelFormat::Yuyv if width.is_multiple_of(2) => n_pixels.checked_mul(2),
        PixelFormat::Nv12 | PixelFormat::Yuyv => None,
    }
}

/// Writes the grey image (rows packed, `width` bytes each) of a packed frame into `gray`.
///
/// Colour is weighted by BT.601; luma formats are taken as they are; a Bayer mosaic is interpolated
/// bilinearly, with the mosaic mirrored at the border.
///
/// # Errors
/// [`FrameBytesMismatch`] when `pixels` is not exactly one frame, or `gray` not exactly `width * height`.
pub fn to_gray(
    format: PixelFormat,
    pixels: &[u8],
    width: usize,
    height: usize,
    gray: &mut [u8],
) -> Result<(), FrameBytesMismatch> {
    let needed = frame_bytes(format, width, height).unwrap_or(0);
    if needed == 0 || pixels.len() != needed {
        return Err(FrameBytesMismatch { bytes: pixels.len(), needed });
    }
    if gray.len() != width * height {
        return Err(FrameBytesMismatch { bytes: gray.len(), needed: width * height });
    }
    match format {
        PixelFormat::Mono8 => gray.copy_from_slice(pixels),
        PixelFormat::Rgb8 => weigh(pixels, gray, |[first, g, last]| luma(first, g, last)),
        PixelFormat::Bgr8 => weigh(pixels, gray, |[first, g, last]| luma(last, g, first)),
        PixelFormat::Nv12 => gray.copy_from_slice(pixels.get(..width * height).unwrap_or(&[])),
        PixelFormat::Yuyv => pixels.chunks_exact(2).zip(gray).for_each(|(pair, out)| *out = pair[0]),
        PixelFormat::BayerRggb8 => interpolate_mosaic(pixels, width, gray),
    }
    Ok(())
}

fn luma(red: u8, green: u8, blue: u8) -> u8 {
    let [r, g, b] = LUMA_WEIGHTS;
    ((u32::from(red) * r + u32::from(green) * g + u32::from(blue) * b + (1 << 15)) >> 16) as u8
}

fn weigh(pixels: &[u8], gray: &mut [u8], gray_of: impl Fn([u8; 3]) -> u8) {
    for (triple, out) in pixels.chunks_exact(3).zip(gray) {
        *out = gray_of([triple[0], triple[1], triple[2]]);
    }
}

/// Neighbour before and after `i`, mirrored so that the colour of the mosaic stays right.
fn mirrored_neighbors(i: usize, n: usize) -> (usize, usize) {
    let before = if i == 0 { 1.min(n - 1) } else { i - 1 };
    let after = if i + 1 < n { i + 1 } else { n.saturating_sub(2) };
    (before, after)
}

fn interpolate_mosaic(pixels: &[u8], width: usize, gray: &mut [u8]) {
    let height = pixels.len() / width;
    let row = |y: usize| &pixels[y * width..(y + 1) * width];
    for (y, out) in gray.chunks_exact_mut(width).enumerate() {
        let (above, below) = mirrored_neighbors(y, height);
        let (above, here, below) = (row(above), row(y), row(below));
        for (x, out) in out.iter_mut().enumerate() {
            let (left, right) = mirrored_neighbors(x, width);
            let horizontal = mean([here[left], here[right]]);
            let vertical = mean([above[x], below[x]]);
            let diagonal = mean([above[left], above[right], below[left], below[right]]);
            let cross = mean([here[left], here[right], above[x], below[x]]);
            *out = match (y % 2, x % 2) {
                (0, 0) => luma(here[x], cross, diagonal),
                (0, _) => luma(horizontal, here[x], vertical),
                (_, 0) => luma(vertical, here[x], horizontal),
                _ => luma(diagonal, cross, here[x]),
            };
        }
    }
}

fn mean<const N: usize>(values: [u8; N]) -> u8 {
    let sum: usize = values.iter().map(|&v| usize::from(v)).sum();
    ((sum + N / 2) / N) as u8
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;
    use std::vec::Vec;

    #[track_caller]
    fn check(format: PixelFormat, size: (usize, usize), pixels: &[u8], gray: &[u8]) {
        let mut out = vec![0xAA; gray.len()];
        assert_eq!(to_gray(format, pixels, size.0, size.1, &mut out), Ok(()));
        assert_eq!(out, gray, "{format:?}");
    }

    #[test]
    fn hand_computed_pixels_of_every_format() {
        check(PixelFormat::Mono8, (2, 2), &[1, 2, 3, 4], &[1, 2, 3, 4]);
        check(PixelFormat::Rgb8, (4, 1), &[255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255], &[76, 150, 29, 255]);
        check(PixelFormat::Bgr8, (2, 1), &[255, 0, 0, 0, 0, 255], &[29, 76]);
        check(PixelFormat::Nv12, (2, 2), &[9, 8, 7, 6, 128, 128], &[9, 8, 7, 6]);
        check(PixelFormat::Yuyv, (2, 2), &[9, 1, 8, 2, 7, 3, 6, 4], &[9, 8, 7, 6]);
    }

    #[test]
    fn a_mosaic_of_one_color_gives_its_luma_everywhere() {
        let (width, height) = (5, 4);
        let [red, green, blue] = [200, 100, 50];
        let mosaic: Vec<u8> = (0..width * height)
            .map(|i| match ((i / width) % 2, (i % width) % 2) {
                (0, 0) => red,
                (1, 1) => blue,
                _ => green,
            })
            .collect();
        check(PixelFormat::BayerRggb8, (width, height), &mosaic, &vec![luma(red, green, blue); width * height]);
        check(PixelFormat::BayerRggb8, (1, 1), &[7], &[7]);
    }

    #[test]
    fn frames_of_the_wrong_length_are_refused() {
        let refused = |format, n_pixels: usize, n_gray: usize| {
            to_gray(format, &vec![0; n_pixels], 4, 2, &mut vec![0; n_gray]).is_err()
        };
        assert!(!refused(PixelFormat::Rgb8, 24, 8));
        assert!(refused(PixelFormat::Rgb8, 23, 8));
        assert!(refused(PixelFormat::Rgb8, 25, 8));
        assert!(refused(PixelFormat::Mono8, 8, 7));
        assert_eq!(frame_bytes(PixelFormat::Nv12, 3, 2), None);
        assert_eq!(frame_bytes(PixelFormat::Yuyv, 3, 2), None);
        assert_eq!(frame_bytes(PixelFormat::Rgb8, usize::MAX, 2), None);
    }
}
