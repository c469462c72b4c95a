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

/// Writes the grey image (rows packed, `width` bytes each) of a frame whose rows start every `stride_bytes` into `gray`.
///
/// Colour is weighted by BT.601; luma formats are taken as they are, and their chroma is not looked at; a Bayer mosaic is
/// interpolated bilinearly, with the mosaic mirrored at the border. Bytes behind the last pixel are not looked at.
///
/// # Errors
/// [`FrameBytesMismatch`] when `pixels` does not cover the frame, or `gray` is not exactly `width * height`.
pub fn to_gray(
    format: PixelFormat,
    pixels: &[u8],
    (width, height): (usize, usize),
    stride_bytes: usize,
    gray: &mut [u8],
) -> Result<(), FrameBytesMismatch> {
    let row_bytes = u32::try_from(width).map_or(usize::MAX, |width| format.row_bytes(width) as usize);
    let needed = stride_bytes.saturating_mul(height.saturating_sub(1)).saturating_add(row_bytes);
    if width == 0 || height == 0 || stride_bytes < row_bytes || pixels.len() < needed {
        return Err(FrameBytesMismatch { bytes: pixels.len(), needed });
    }
    if Some(gray.len()) != width.checked_mul(height) {
        return Err(FrameBytesMismatch { bytes: gray.len(), needed: width.saturating_mul(height) });
    }
    let row = |y: usize| &pixels[y * stride_bytes..y * stride_bytes + row_bytes];
    for (y, out) in gray.chunks_exact_mut(width).enumerate() {
        match format {
            PixelFormat::Mono8 | PixelFormat::Nv12 => out.copy_from_slice(row(y)),
            PixelFormat::Rgb8 => weigh(row(y), out, |[first, g, last]| luma(first, g, last)),
            PixelFormat::Bgr8 => weigh(row(y), out, |[first, g, last]| luma(last, g, first)),
            PixelFormat::Yuyv => row(y).chunks_exact(2).zip(out).for_each(|(pair, out)| *out = pair[0]),
            PixelFormat::BayerRggb8 => {
                let (above, below) = mirrored_neighbors(y, height);
                interpolate_mosaic([row(above), row(y), row(below)], y % 2 == 0, out);
            }
        }
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

fn interpolate_mosaic([above, here, below]: [&[u8]; 3], has_red: bool, gray: &mut [u8]) {
    let width = gray.len();
    for (x, out) in gray.iter_mut().enumerate() {
        let (left, right) = mirrored_neighbors(x, width);
        let horizontal = mean([here[left], here[right]]);
        let vertical = mean([above[x], below[x]]);
        let diagonal = mean([above[left], above[right], below[left], below[right]]);
        let cross = mean([here[left], here[right], above[x], below[x]]);
        *out = match (has_red, x % 2) {
            (true, 0) => luma(here[x], cross, diagonal),
            (true, _) => luma(horizontal, here[x], vertical),
            (false, 0) => luma(vertical, here[x], horizontal),
            (false, _) => luma(diagonal, cross, here[x]),
        };
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

    /// The frame as it is, and with three bytes behind every row and more behind the last.
    #[track_caller]
    fn check(format: PixelFormat, size: (usize, usize), pixels: &[u8], gray: &[u8]) {
        let row_bytes = format.row_bytes(size.0 as u32) as usize;
        for padding in [0, 3] {
            let rows = pixels.chunks(row_bytes).flat_map(|row| row.iter().copied().chain((0..padding).map(|_| 99)));
            let padded: Vec<u8> = rows.chain([99; 5]).collect();
            let mut out = vec![0xAA; gray.len()];
            assert_eq!(to_gray(format, &padded, size, row_bytes + padding, &mut out), Ok(()));
            assert_eq!(out, gray, "{format:?}, {padding}");
        }
    }

    #[test]
    fn hand_computed_pixels_of_every_format() {
        check(PixelFormat::Mono8, (2, 2), &[1, 2, 3, 4], &[1, 2, 3, 4]);
        check(PixelFormat::Rgb8, (4, 1), &[255, 0, 0, 0, 255, 0, 0, 0, 255, 255, 255, 255], &[76, 150, 29, 255]);
        check(PixelFormat::Bgr8, (2, 1), &[255, 0, 0, 0, 0, 255], &[29, 76]);
        check(PixelFormat::Nv12, (2, 2), &[9, 8, 7, 6, 128, 128], &[9, 8, 7, 6]);
        check(PixelFormat::Yuyv, (2, 2), &[9, 1, 8, 2, 7, 3, 6, 4], &[9, 8, 7, 6]);
        // Sides that do not divide evenly have their last luma all the same.
        check(PixelFormat::Nv12, (3, 1), &[9, 8, 7, 128, 128, 128], &[9, 8, 7]);
        check(PixelFormat::Yuyv, (3, 1), &[9, 1, 8, 2, 7, 3], &[9, 8, 7]);
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
        let refused = |stride_bytes: usize, n_pixels: usize, n_gray: usize| {
            let (pixels, mut gray) = (vec![0; n_pixels], vec![0; n_gray]);
            to_gray(PixelFormat::Rgb8, &pixels, (4, 2), stride_bytes, &mut gray).is_err()
        };
        assert!(!refused(12, 24, 8));
        assert!(!refused(12, 25, 8), "what is behind the frame does not matter");
        assert!(refused(12, 23, 8));
        assert!(refused(13, 24, 8));
        assert!(refused(11, 24, 8), "rows that overlap");
        assert!(refused(12, 24, 7));
        assert!(to_gray(PixelFormat::Mono8, &[1], (usize::MAX, 2), 1, &mut []).is_err());
        assert!(to_gray(PixelFormat::Mono8, &[], (0, 0), 0, &mut []).is_err());
    }
}
