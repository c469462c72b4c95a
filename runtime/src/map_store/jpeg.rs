//! Camera images as JPEG files.

use super::StoreError;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use kilogs_core::frame::PixelFormat;
use std::path::Path;

/// Bytes per pixel of the formats that can be stored; `None` for the others, which must be converted before.
pub(super) fn bytes_per_pixel(format: PixelFormat) -> Option<usize> {
    match format {
        PixelFormat::Mono8 => Some(1),
        PixelFormat::Rgb8 | PixelFormat::Bgr8 => Some(3),
        PixelFormat::Nv12 | PixelFormat::Yuyv | PixelFormat::BayerRggb8 => None,
    }
}

/// Writes packed `pixels` as JPEG to `out`, which is emptied first; BGR is turned into RGB in place.
pub(super) fn encode(
    pixels: &mut [u8],
    (width, height): (u32, u32),
    format: PixelFormat,
    quality: u8,
    out: &mut Vec<u8>,
) -> Result<(), image::ImageError> {
    out.clear();
    let color = match format {
        PixelFormat::Mono8 => ExtendedColorType::L8,
        PixelFormat::Bgr8 => {
            for pixel in pixels.as_chunks_mut::<3>().0 {
                pixel.swap(0, 2);
            }
            ExtendedColorType::Rgb8
        }
        _ => ExtendedColorType::Rgb8,
    };
    JpegEncoder::new_with_quality(out, quality).encode(pixels, width, height, color)
}

/// Reads and verifies an image of a map, grey ones too, as RGB.
pub(super) fn read_rgb(path: &Path, bytes: u32, crc: u32) -> Result<image::RgbImage, StoreError> {
    let wrong = |reason: String| StoreError::Image { path: path.to_owned(), reason };
    if bytes == 0 {
        return Err(wrong("was not stored".to_owned()));
    }
    let file = std::fs::read(path).map_err(|e| StoreError::read("opening", path, e))?;
    if file.len() != bytes as usize {
        return Err(wrong(format!("{} of {bytes} bytes are there", file.len())));
    }
    let computed_crc = crc32fast::hash(&file);
    if computed_crc != crc {
        return Err(wrong(format!("checksum is {computed_crc:08x}, {crc:08x} was stored")));
    }
    let decoded = image::load_from_memory_with_format(&file, image::ImageFormat::Jpeg);
    decoded.map(|picture| picture.to_rgb8()).map_err(|e| wrong(e.to_string()))
}
