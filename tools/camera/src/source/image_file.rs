//! Decodes an image file straight into the memory that is then published.

use std::fs::File;
use std::io::{Cursor, Read};
use std::path::Path;

use image::codecs::{jpeg::JpegDecoder, png::PngDecoder};
use image::{ColorType, DynamicImage, ImageDecoder, ImageFormat};
use kilogs_core::frame::PixelFormat;

use super::rectifier::{Distortion, Rectifier};

/// What the header of an image file says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ImageKind {
    pub size: [u32; 2],
    pub pixel_format: PixelFormat,
}

/// Reads image files one after another, in the same buffer.
#[derive(Default)]
pub(super) struct ImageReader {
    encoded: Vec<u8>,
    rectifier: Option<Rectifier>,
}

impl ImageReader {
    /// From now on delivers images as an ideal camera would have taken them.
    pub fn rectify(&mut self, distortion: Option<Distortion>) {
        self.rectifier = distortion.map(Rectifier::new);
    }

    /// Size and color of the image, from its header.
    pub fn probe(&mut self, path: &Path) -> Result<ImageKind, String> {
        match self.load(path)? {
            ImageFormat::Png => Ok(kind_of(&png(&self.encoded)?)),
            _ => Ok(kind_of(&jpeg(&self.encoded)?)),
        }
    }

    /// Decodes the image, which must be of `expected.size`; its color is converted where it differs.
    pub fn decode(&mut self, path: &Path, expected: ImageKind, pixels: &mut [u8]) -> Result<(), String> {
        let Some(mut rectifier) = self.rectifier.take() else { return self.decode_photo(path, expected, pixels) };
        let photo = |photo: &mut [u8]| self.decode_photo(path, expected, photo);
        let result = rectifier.rectify(expected.pixel_format, pixels, photo);
        self.rectifier = Some(rectifier);
        result
    }

    fn decode_photo(&mut self, path: &Path, expected: ImageKind, pixels: &mut [u8]) -> Result<(), String> {
        match self.load(path)? {
            ImageFormat::Png => decode_into(png(&self.encoded)?, expected, pixels),
            _ => {
                // The decoder fills what is missing with grey and reports success.
                if !is_complete_jpeg(&self.encoded) {
                    return Err("the file is truncated: its end marker is missing".to_owned());
                }
                decode_into(jpeg(&self.encoded)?, expected, pixels)
            }
        }
    }

    fn load(&mut self, path: &Path) -> Result<ImageFormat, String> {
        self.encoded.clear();
        File::open(path).and_then(|mut file| file.read_to_end(&mut self.encoded)).map_err(|e| e.to_string())?;
        match image::guess_format(&self.encoded) {
            Ok(format @ (ImageFormat::Png | ImageFormat::Jpeg)) => Ok(format),
            _ if self.encoded.is_empty() => Err("the file is empty".to_owned()),
            _ => Err("the file is neither PNG nor JPEG".to_owned()),
        }
    }
}

fn png(encoded: &[u8]) -> Result<PngDecoder<Cursor<&[u8]>>, String> {
    PngDecoder::new(Cursor::new(encoded)).map_err(|e| e.to_string())
}

fn jpeg(encoded: &[u8]) -> Result<JpegDecoder<Cursor<&[u8]>>, String> {
    JpegDecoder::new(Cursor::new(encoded)).map_err(|e| e.to_string())
}

fn kind_of(decoder: &impl ImageDecoder) -> ImageKind {
    let (width, height) = decoder.dimensions();
    let pixel_format = if decoder.color_type().has_color() { PixelFormat::Rgb8 } else { PixelFormat::Mono8 };
    ImageKind { size: [width, height], pixel_format }
}

fn decode_into(decoder: impl ImageDecoder, expected: ImageKind, pixels: &mut [u8]) -> Result<(), String> {
    let ([width, height], [expected_width, expected_height]) = (kind_of(&decoder).size, expected.size);
    if [width, height] != expected.size {
        return Err(format!("the image has {width}x{height} px, the recording {expected_width}x{expected_height} px"));
    }
    let converted = match (decoder.color_type(), expected.pixel_format) {
        (ColorType::L8, PixelFormat::Mono8) | (ColorType::Rgb8, PixelFormat::Rgb8) => {
            return decoder.read_image(pixels).map_err(|e| e.to_string());
        }
        (_, PixelFormat::Mono8) => {
            DynamicImage::from_decoder(decoder).map_err(|e| e.to_string())?.to_luma8().into_raw()
        }
        (_, PixelFormat::Rgb8) => DynamicImage::from_decoder(decoder).map_err(|e| e.to_string())?.to_rgb8().into_raw(),
        (_, other) => return Err(format!("image files are not converted to {other:?}")),
    };
    if converted.len() != pixels.len() {
        return Err(format!("the image has {} bytes, {} are expected", converted.len(), pixels.len()));
    }
    pixels.copy_from_slice(&converted);
    Ok(())
}

/// Whether the last scan of a JPEG is followed by the end marker. Within a scan the byte 0xFF is always stuffed, so
/// that neither marker can be part of the picture; an embedded thumbnail comes before the picture's own scan.
fn is_complete_jpeg(encoded: &[u8]) -> bool {
    const START_OF_SCAN: [u8; 2] = [0xFF, 0xDA];
    const END_OF_IMAGE: [u8; 2] = [0xFF, 0xD9];
    let last = |marker: [u8; 2]| encoded.windows(2).rposition(|pair| pair == marker);
    match (last(START_OF_SCAN), last(END_OF_IMAGE)) {
        (Some(scan), Some(end)) => end > scan,
        _ => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, Luma, Rgb, RgbImage};

    const SIZE: [u32; 2] = [24, 16];

    fn write(image: &DynamicImage, name: &str, keep_eighths: Option<usize>) -> (tempfile::TempDir, std::path::PathBuf) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join(name);
        image.save(&path).expect("an image");
        if let Some(eighths) = keep_eighths {
            let bytes = std::fs::read(&path).expect("the image");
            std::fs::write(&path, &bytes[..bytes.len() * eighths / 8]).expect("the image");
        }
        (folder, path)
    }

    fn grey() -> DynamicImage {
        GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([(x * 9 + y * 3) as u8])).into()
    }

    fn color() -> DynamicImage {
        RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| Rgb([(x * 9) as u8, (y * 9) as u8, 77])).into()
    }

    fn check(
        image: &DynamicImage,
        name: &str,
        keep: Option<usize>,
        size: [u32; 2],
        as_format: PixelFormat,
    ) -> Result<Vec<u8>, String> {
        let (_folder, path) = write(image, name, keep);
        let mut pixels = vec![0; as_format.packed_bytes(size[0], size[1]) as usize];
        let expected = ImageKind { size, pixel_format: as_format };
        ImageReader::default().decode(&path, expected, &mut pixels).map(|()| pixels)
    }

    #[test]
    fn grey_and_color_arrive_as_they_are() {
        let (grey, color) = (grey(), color());
        assert_eq!(check(&grey, "a.png", None, SIZE, PixelFormat::Mono8).as_deref(), Ok(grey.as_bytes()));
        assert_eq!(check(&color, "a.png", None, SIZE, PixelFormat::Rgb8).as_deref(), Ok(color.as_bytes()));
        let from_jpeg = check(&grey, "a.jpg", None, SIZE, PixelFormat::Mono8).expect("a picture");
        let worst = from_jpeg.iter().zip(grey.as_bytes()).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst < Some(16), "{worst:?}");
    }

    #[test]
    fn a_stray_color_is_converted() {
        let (grey, color) = (grey(), color());
        let expected = color.to_luma8().into_raw();
        assert_eq!(check(&color, "a.png", None, SIZE, PixelFormat::Mono8), Ok(expected));
        let expected = grey.to_rgb8().into_raw();
        assert_eq!(check(&grey, "a.png", None, SIZE, PixelFormat::Rgb8), Ok(expected));
        let deep = DynamicImage::from(grey.to_luma16());
        assert_eq!(check(&deep, "a.png", None, SIZE, PixelFormat::Mono8).as_deref(), Ok(grey.as_bytes()));
    }

    #[test]
    fn a_truncated_file_never_passes() {
        for name in ["a.png", "a.jpg"] {
            for eighths in 0..8 {
                let result = check(&color(), name, Some(eighths), SIZE, PixelFormat::Rgb8);
                assert!(result.is_err(), "{name} cut to {eighths}/8");
            }
        }
    }

    #[test]
    fn another_size_is_named() {
        let reason = check(&grey(), "a.png", None, [24, 17], PixelFormat::Mono8).expect_err("another size");
        assert_eq!(reason, "the image has 24x16 px, the recording 24x17 px");
    }
}
