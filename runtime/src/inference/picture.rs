//! A camera image as a network sees it: as large as fits, in the upper left corner, its border repeated beyond.

use image::imageops::{FilterType, resize};
use image::{GrayImage, ImageBuffer};

/// A grey image of the camera, rows without gaps.
#[derive(Debug, Clone, Default)]
pub(super) struct Picture {
    pub pixels: Vec<u8>,
    pub width: usize,
    pub height: usize,
}

/// Where a camera image lies in a network's input.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fit {
    /// Size of the network's input, px.
    pub input: (usize, usize),
    /// Size of the image in it, px.
    pub content: (usize, usize),
    /// Pixels of the network for one pixel of the camera; both axes are rounded on their own.
    pub scale: [f32; 2],
}

impl Fit {
    /// Never enlarges: that would show nothing new.
    pub(super) fn new(image: (usize, usize), input: (usize, usize)) -> Self {
        let shrink = (input.0 as f64 / image.0.max(1) as f64).min(input.1 as f64 / image.1.max(1) as f64).min(1.0);
        let along = |side: usize, most: usize| ((side as f64 * shrink).round() as usize).clamp(1, most.max(1));
        let content = (along(image.0, input.0), along(image.1, input.1));
        let scale = [content.0 as f32 / image.0.max(1) as f32, content.1 as f32 / image.1.max(1) as f32];
        Self { input, content, scale }
    }

    /// Pixel of the camera at a place of the network's input; both centre pixels at +0.5.
    pub(super) fn camera_px(&self, network_px: [f32; 2]) -> [f32; 2] {
        [network_px[0] / self.scale[0], network_px[1] / self.scale[1]]
    }

    /// The inverse of [`Fit::camera_px`].
    pub(super) fn network_px(&self, camera_px: [f32; 2]) -> [f32; 2] {
        [camera_px[0] * self.scale[0], camera_px[1] * self.scale[1]]
    }

    /// The network's input, white is 1: one plane, then the same again for each further channel, each less its mean and
    /// divided by its standard deviation.
    pub(super) fn planes(&self, picture: &Picture, channels: &[(f32, f32)]) -> Vec<f32> {
        let size = (picture.width, picture.height);
        let shrunk = (self.content != size).then(|| shrink(picture, self.content));
        let pixels = shrunk.as_deref().unwrap_or(&picture.pixels);
        let mut planes = Vec::with_capacity(self.input.0 * self.input.1 * channels.len());
        for &(mean, deviation) in channels {
            for y in 0..self.input.1 {
                let start = y.min(self.content.1 - 1) * self.content.0;
                let row = &pixels[start..start + self.content.0];
                let last = row[row.len() - 1];
                let beyond = std::iter::repeat_n(last, self.input.0 - self.content.0);
                planes.extend(row.iter().copied().chain(beyond).map(|v| (f32::from(v) / 255.0 - mean) / deviation));
            }
        }
        planes
    }
}

/// A map of numbers at a place between its pixels' centres, which lie at +0.5; beyond them, the border's.
pub(super) fn bilinear(map: &[f32], (width, height): (usize, usize), x: f32, y: f32) -> f32 {
    let along = |c: f32, side: usize| {
        let c = (c - 0.5).clamp(0.0, (side - 1) as f32);
        let first = (c as usize).min(side.saturating_sub(2));
        (first, (first + 1).min(side - 1), c - first as f32)
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (along(x, width), along(y, height));
    let across = |y: usize| map[y * width + x0] * (1.0 - fx) + map[y * width + x1] * fx;
    across(y0) * (1.0 - fy) + across(y1) * fy
}

/// Filters while it shrinks, so that fine texture does not alias; pixel centres stay where they are.
fn shrink(picture: &Picture, size: (usize, usize)) -> Vec<u8> {
    let (width, height) = (picture.width as u32, picture.height as u32);
    let whole: Option<GrayImage> = ImageBuffer::from_raw(width, height, picture.pixels.clone());
    let whole = whole.unwrap_or_else(|| GrayImage::new(width, height));
    resize(&whole, size.0 as u32, size.1 as u32, FilterType::Triangle).into_raw()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_keeps_its_shape_and_its_pixel_centres() {
        let check = |image: (usize, usize), input, content, corner_px: [f32; 2]| {
            let fit = Fit::new(image, input);
            assert_eq!(fit.content, content, "{image:?} in {input:?}");
            let corner = fit.network_px([image.0 as f32, image.1 as f32]);
            assert_eq!(corner, corner_px, "the lower right corner of {image:?}");
            let there = fit.camera_px(fit.network_px([100.5, 50.5]));
            assert!((there[0] - 100.5).abs() < 1e-4 && (there[1] - 50.5).abs() < 1e-4, "{there:?}");
        };
        check((1241, 376), (1248, 384), (1241, 376), [1241.0, 376.0]);
        check((1241, 376), (640, 192), (634, 192), [634.0, 192.0]);
        check((1920, 1080), (1248, 384), (683, 384), [683.0, 384.0]);
        check((620, 188), (640, 192), (620, 188), [620.0, 188.0]);
    }

    #[test]
    fn the_border_is_repeated_and_every_channel_normalized() {
        let picture = Picture { pixels: vec![0, 255, 51, 102], width: 2, height: 2 };
        let planes = Fit::new((2, 2), (3, 3)).planes(&picture, &[(0.0, 1.0), (1.0, 0.5)]);
        let expected = [0.0, 1.0, 1.0, 0.2, 0.4, 0.4, 0.2, 0.4, 0.4];
        for (idx, value) in expected.into_iter().enumerate() {
            assert!((planes[idx] - value).abs() < 1e-6, "{planes:?}");
            assert!((planes[9 + idx] - (value - 1.0) * 2.0).abs() < 1e-6, "{planes:?}");
        }
    }

    #[test]
    fn a_ramp_stays_where_it_is_when_it_is_shrunk() {
        let (width, height) = (400, 100);
        let pixels = (0..width * height).map(|i| (50 + (i % width) / 4) as u8).collect();
        let fit = Fit::new((width, height), (200, 64));
        let planes = fit.planes(&Picture { pixels, width, height }, &[(0.0, 1.0)]);
        for x in 5..195 {
            let camera_px = fit.camera_px([x as f32 + 0.5, 20.5])[0];
            let value = 255.0 * planes[20 * 200 + x];
            let expected = 50.0 + (camera_px - 0.5 - 1.5) / 4.0;
            assert!((value - expected).abs() < 0.7, "at {x}: {value}, expected {expected}");
        }
    }
}
