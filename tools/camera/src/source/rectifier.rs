//! Takes the lens out of images as they are read.

use kilogs_core::camera::rectify::{SourcePixel, fill_table, ideal_camera, rectify};
use kilogs_core::camera::{Lens, Pinhole};
use kilogs_core::frame::PixelFormat;

/// A lens that is no pinhole, and the camera that its images are turned into those of.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Distortion {
    lens: Lens,
    seen: Pinhole,
    ideal: Pinhole,
}

impl Distortion {
    /// The ideal camera, and what it takes to get its images from those of the camera `seen`; nothing for a pinhole.
    pub(super) fn of(lens: Lens, seen: Pinhole) -> Result<(Pinhole, Option<Self>), String> {
        let ideal = ideal_camera(&lens, &seen).map_err(|problem| {
            format!(
                "{problem}; keep OpenCV's order of coefficients, the size of the images that were calibrated, and \
                 calibrate with marks up to the corners"
            )
        })?;
        Ok((ideal, (lens != Lens::Pinhole).then_some(Self { lens, seen, ideal })))
    }
}

/// Rectifies image after image, in memory that is taken with the first: eight bytes per pixel and one image.
pub(super) struct Rectifier {
    distortion: Distortion,
    table: Vec<SourcePixel>,
    photo: Vec<u8>,
}

impl Rectifier {
    pub(super) fn new(distortion: Distortion) -> Self {
        Self { distortion, table: Vec::new(), photo: Vec::new() }
    }

    /// Writes the rectified form of what `take` delivers into `pixels`.
    pub(super) fn rectify(
        &mut self,
        pixel_format: PixelFormat,
        pixels: &mut [u8],
        take: impl FnOnce(&mut [u8]) -> Result<(), String>,
    ) -> Result<(), String> {
        let Distortion { lens, seen, ideal } = &self.distortion;
        if self.table.is_empty() {
            self.table.resize(ideal.width as usize * ideal.height as usize, SourcePixel::default());
            fill_table(lens, seen, ideal, &mut self.table);
        }
        self.photo.resize(pixels.len(), 0);
        take(&mut self.photo)?;
        let width = seen.width as usize;
        match pixel_format {
            PixelFormat::Mono8 => rectify::<1>(&self.table, width, &self.photo, pixels),
            PixelFormat::Rgb8 | PixelFormat::Bgr8 => rectify::<3>(&self.table, width, &self.photo, pixels),
            other => return Err(format!("images in {other:?} are not rectified")),
        }
        Ok(())
    }
}
