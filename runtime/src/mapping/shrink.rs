//! Camera images at mapping resolution: area-averaged, so that no detail aliases.

use super::images::MappingImage;
use kilogs_core::camera::Pinhole;
use kilogs_core::frame::PixelFormat;

/// The camera at mapping resolution; at least one pixel each way.
pub fn mapping_camera(native: &Pinhole, resolution: f64) -> Pinhole {
    let scaled = |side_px: u32| ((f64::from(side_px) * resolution).round() as u32).clamp(1, side_px.max(1));
    native.resized(scaled(native.width), scaled(native.height))
}

/// Bytes per pixel that mapping keeps of a format; `None` for formats that mapping cannot read.
pub fn channels(format: PixelFormat) -> Option<usize> {
    match format {
        PixelFormat::Mono8 => Some(1),
        PixelFormat::Rgb8 | PixelFormat::Bgr8 => Some(3),
        PixelFormat::Nv12 | PixelFormat::Yuyv | PixelFormat::BayerRggb8 => None,
    }
}

/// Averages `image` over the area of each pixel of `camera`'s size; three channels come out as RGB.
///
/// False when the image does not have the bytes that its size asks for, or `out` another size.
pub fn shrink(image: &MappingImage<'_>, native: &Pinhole, camera: &Pinhole, out: &mut [u8]) -> bool {
    let Some(channels) = channels(image.format) else { return false };
    let (width, height) = (native.width as usize, native.height as usize);
    let (out_width, out_height) = (camera.width as usize, camera.height as usize);
    let needed = (height.saturating_sub(1)) * image.stride_bytes + width * channels;
    if image.stride_bytes < width * channels
        || image.pixels.len() < needed
        || out.len() != out_width * out_height * channels
    {
        return false;
    }
    let (step_x, step_y) = (width as f32 / out_width as f32, height as f32 / out_height as f32);
    for (y, row) in out.chunks_exact_mut(out_width * channels).enumerate() {
        let (top, bottom) = (y as f32 * step_y, (y + 1) as f32 * step_y);
        for (x, pixel) in row.chunks_exact_mut(channels).enumerate() {
            let (left, right) = (x as f32 * step_x, (x + 1) as f32 * step_x);
            let mut sum = [0.0f32; 3];
            for v in top as usize..(bottom.ceil() as usize).min(height) {
                let covered_y = bottom.min(v as f32 + 1.0) - top.max(v as f32);
                for u in left as usize..(right.ceil() as usize).min(width) {
                    let weight = covered_y * (right.min(u as f32 + 1.0) - left.max(u as f32));
                    let at = v * image.stride_bytes + u * channels;
                    for (sum, &value) in sum.iter_mut().zip(&image.pixels[at..at + channels]) {
                        *sum += weight * f32::from(value);
                    }
                }
            }
            for (value, sum) in pixel.iter_mut().zip(sum) {
                *value = (sum / (step_x * step_y) + 0.5) as u8;
            }
            if image.format == PixelFormat::Bgr8 {
                pixel.swap(0, 2);
            }
        }
    }
    true
}

/// Brightness of a pixel of one or three channels (ITU-R BT.601).
pub fn luma(pixel: &[u8]) -> u8 {
    match *pixel {
        [red, green, blue] => {
            ((299 * u32::from(red) + 587 * u32::from(green) + 114 * u32::from(blue) + 500) / 1000) as u8
        }
        [grey, ..] => grey,
        [] => 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(width: u32, height: u32) -> Pinhole {
        Pinhole { width, height, fx: 10.0, fy: 10.0, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0 }
    }

    fn check(format: PixelFormat, pixels: &[u8], size: (u32, u32, usize), out_size: (u32, u32), expected: &[u8]) {
        let (width, height, stride_bytes) = size;
        let mut out = vec![7; expected.len()];
        let image = MappingImage { pixels, stride_bytes, format };
        let done = shrink(&image, &camera(width, height), &camera(out_size.0, out_size.1), &mut out);
        assert!(done, "{format:?} {size:?}");
        assert_eq!(out, expected, "{format:?} {size:?}");
    }

    #[test]
    fn pixels_are_averaged_by_the_area_they_cover() {
        check(PixelFormat::Mono8, &[0, 100, 9, 50, 250, 9], (2, 2, 3), (1, 1), &[100]);
        check(PixelFormat::Mono8, &[30, 60, 90], (3, 1, 3), (2, 1), &[40, 80]);
        check(PixelFormat::Mono8, &[1, 2, 3, 4], (2, 2, 2), (2, 2), &[1, 2, 3, 4]);
        check(PixelFormat::Rgb8, &[10, 20, 30, 20, 40, 60], (2, 1, 6), (1, 1), &[15, 30, 45]);
        check(PixelFormat::Bgr8, &[10, 20, 30, 20, 40, 60], (2, 1, 6), (1, 1), &[45, 30, 15]);
    }

    #[test]
    fn truncated_images_and_unreadable_formats_are_refused() {
        let mut out = [0; 1];
        for (pixels, format) in [(&[0u8; 3][..], PixelFormat::Mono8), (&[0; 99], PixelFormat::Nv12)] {
            let image = MappingImage { pixels, stride_bytes: 2, format };
            assert!(!shrink(&image, &camera(2, 2), &camera(1, 1), &mut out), "{format:?}");
        }
    }

    #[test]
    fn the_mapping_camera_looks_the_same_way() {
        let mapped = mapping_camera(&camera(1241, 376), 0.5);
        assert_eq!((mapped.width, mapped.height), (621, 188));
        assert!((mapped.cx * 1241.0 / 621.0 - 620.5).abs() < 1e-9);
        assert_eq!(mapping_camera(&camera(3, 3), 0.01).width, 1);
    }
}
