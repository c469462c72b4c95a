//! A camera's pixels, in the shapes that tracking and mapping read.

use crate::input::BorrowedFrame;
use kilogs_core::frame::{ImageView, PixelFormat, to_gray};

/// Pixels as the camera sends them.
#[derive(Debug, Clone, Copy)]
pub struct CameraImage<'a> {
    /// Rows of pixels.
    pub pixels: &'a [u8],
    /// How they are to be read.
    pub format: PixelFormat,
    /// Width and height, px.
    pub size: (usize, usize),
    /// Bytes between the starts of two rows.
    pub stride_bytes: usize,
}

impl<'a> CameraImage<'a> {
    /// The pixels of a frame, where the camera process wrote them.
    pub fn of_frame(frame: &'a BorrowedFrame<'_>) -> Self {
        let header = frame.header();
        let [width, height, stride_bytes] = [header.width, header.height, header.stride_bytes].map(|n| n as usize);
        Self { pixels: frame.pixels(), format: frame.pixel_format(), size: (width, height), stride_bytes }
    }

    /// Whether the pixels begin with a plane of grey ones.
    pub fn has_gray_plane(&self) -> bool {
        matches!(self.format, PixelFormat::Mono8 | PixelFormat::Nv12)
    }

    /// The image in grey: where it lies if it is grey there, otherwise converted into `buffer`. `None` when the pixels
    /// do not cover the size.
    pub fn gray(&self, buffer: &'a mut [u8]) -> Option<ImageView<'a>> {
        let (width, height) = self.size;
        if self.has_gray_plane() {
            return ImageView::new(self.pixels, width, height, self.stride_bytes).ok();
        }
        to_gray(self.format, self.pixels, self.size, self.stride_bytes, buffer).ok()?;
        ImageView::new(buffer, width, height, width).ok()
    }

    /// Writes the image as packed pixels of a map's format, [`PixelFormat::Mono8`] or [`PixelFormat::Rgb8`]. Formats that
    /// carry their colors otherwise than as RGB or BGR give the brightness of `gray`, the same image.
    pub fn pack(&self, gray: &ImageView<'_>, map_format: PixelFormat, packed: &mut [u8]) {
        let (width, height) = self.size;
        let row_bytes = map_format.row_bytes(width as u32) as usize;
        for (y, packed) in packed.chunks_exact_mut(row_bytes).take(height).enumerate() {
            let row = self.pixels.get(y * self.stride_bytes..).and_then(|rows| rows.get(..row_bytes));
            match (map_format, self.format, row) {
                (PixelFormat::Mono8, _, _) => packed.copy_from_slice(gray.row(y)),
                (_, PixelFormat::Rgb8, Some(row)) => packed.copy_from_slice(row),
                (_, PixelFormat::Bgr8, Some(row)) => {
                    for (rgb, bgr) in packed.chunks_exact_mut(3).zip(row.chunks_exact(3)) {
                        rgb.copy_from_slice(&[bgr[2], bgr[1], bgr[0]]);
                    }
                }
                _ => packed.chunks_exact_mut(3).zip(gray.row(y)).for_each(|(rgb, gray)| rgb.fill(*gray)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An image of 2x2 px with `padding` bytes behind every row; what the map gets of it.
    fn check(format: PixelFormat, rows: [&[u8]; 2], padding: usize, map_format: PixelFormat, expected: &[u8]) {
        let mut pixels: Vec<u8> =
            rows.iter().flat_map(|row| [row, [77; 8].get(..padding).expect("few")].concat()).collect();
        // Chroma, and whatever a camera sends behind its image.
        pixels.extend([128; 9]);
        let stride_bytes = rows[0].len() + padding;
        let image = CameraImage { pixels: &pixels, format, size: (2, 2), stride_bytes };
        let (mut buffer, mut packed) = ([0; 4], vec![55; expected.len()]);
        let gray = image.gray(&mut buffer).expect("enough pixels");
        image.pack(&gray, map_format, &mut packed);
        assert_eq!(packed, expected, "{format:?} with {padding} bytes behind its rows, as {map_format:?}");
    }

    #[test]
    fn every_camera_gives_packed_pixels_of_the_maps_format() {
        use PixelFormat::{BayerRggb8, Bgr8, Mono8, Nv12, Rgb8, Yuyv};
        let tripled = [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4];
        for padding in [0, 3] {
            check(Mono8, [&[1, 2], &[3, 4]], padding, Mono8, &[1, 2, 3, 4]);
            check(Mono8, [&[1, 2], &[3, 4]], padding, Rgb8, &tripled);
            check(Nv12, [&[1, 2], &[3, 4]], padding, Rgb8, &tripled);
            check(Yuyv, [&[1, 9, 2, 9], &[3, 9, 4, 9]], padding, Rgb8, &tripled);
            check(BayerRggb8, [&[5, 5], &[5, 5]], padding, Rgb8, &[5; 12]);
            let (first, second) = ([1, 2, 3, 4, 5, 6], [7, 8, 9, 10, 11, 12]);
            check(Rgb8, [&first, &second], padding, Rgb8, &[1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
            check(Bgr8, [&first, &second], padding, Rgb8, &[3, 2, 1, 6, 5, 4, 9, 8, 7, 12, 11, 10]);
            check(Rgb8, [&[255, 0, 0, 0, 255, 0], &[0, 0, 255, 9, 9, 9]], padding, Mono8, &[76, 150, 29, 9]);
        }
    }

    #[test]
    fn an_image_that_is_too_short_is_none() {
        let image =
            |n: usize| CameraImage { pixels: &[0; 9][..n], format: PixelFormat::Mono8, size: (2, 3), stride_bytes: 3 };
        assert!(image(8).gray(&mut []).is_some());
        assert!(image(7).gray(&mut []).is_none());
    }
}
