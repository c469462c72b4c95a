//! Images of any view at any resolution, read where they are stored and kept as long as a fixed memory allows.

use crate::mapping::{MappingImage, mapping_camera, shrink};
use kilogs_camera::source::{ImageList, PixelFormat, SourceError};
use kilogs_core::camera::Pinhole;

/// Where images come from, all of the same size.
pub(crate) trait ImageSource {
    /// Why an image cannot be read.
    type Error;

    /// Bytes of an image.
    fn bytes(&self) -> usize;

    /// One byte of grey or three of color.
    fn pixel_format(&self) -> PixelFormat;

    /// Reads an image into memory of [`bytes`](Self::bytes).
    fn read(&mut self, view_idx: usize, pixels: &mut [u8]) -> Result<(), Self::Error>;
}

impl ImageSource for ImageList {
    type Error = SourceError;

    fn bytes(&self) -> usize {
        Self::bytes(self)
    }

    fn pixel_format(&self) -> PixelFormat {
        Self::pixel_format(self)
    }

    fn read(&mut self, view_idx: usize, pixels: &mut [u8]) -> Result<(), SourceError> {
        Self::read(self, view_idx, pixels)
    }
}

/// Reads images and keeps some of them at the resolution that is trained at present.
pub(crate) struct TrainingImages<S> {
    source: S,
    native: Pinhole,
    channels: usize,
    /// The image that was decoded last.
    decoded: Vec<u8>,
    decoded_idx: Option<usize>,
    /// Memory of the kept images, shared out in slots of the present size.
    kept: Vec<u8>,
    views: Vec<Option<usize>>,
    camera: Pinhole,
}

impl<S: ImageSource> TrainingImages<S> {
    /// Room for `kept_bytes` of images, but at least one.
    pub(crate) fn new(source: S, native: Pinhole, kept_bytes: usize) -> Self {
        let channels = if source.pixel_format() == PixelFormat::Mono8 { 1 } else { 3 };
        let kept_bytes = kept_bytes.max(source.bytes());
        Self {
            decoded: vec![0; source.bytes()],
            decoded_idx: None,
            kept: vec![0; kept_bytes],
            views: vec![None; kept_bytes / source.bytes()],
            camera: native,
            native,
            channels,
            source,
        }
    }

    /// One byte of grey or three of color.
    pub(crate) fn channels(&self) -> usize {
        self.channels
    }

    /// An image as it is.
    pub(crate) fn native(&mut self, view_idx: usize) -> Result<MappingImage<'_>, S::Error> {
        self.decode(view_idx)?;
        Ok(MappingImage {
            pixels: &self.decoded,
            stride_bytes: self.native.width as usize * self.channels,
            format: self.source.pixel_format(),
        })
    }

    /// An image at a share of its resolution, with its camera.
    pub(crate) fn at(&mut self, view_idx: usize, resolution: f64) -> Result<(Pinhole, &[u8]), S::Error> {
        let camera = mapping_camera(&self.native, resolution);
        let image_bytes = camera.width as usize * camera.height as usize * self.channels;
        if camera != self.camera {
            self.camera = camera;
            self.views.clear();
            self.views.resize((self.kept.len() / image_bytes).max(1), None);
        }
        let slot = view_idx % self.views.len();
        let place = slot * image_bytes..(slot + 1) * image_bytes;
        if self.views[slot] != Some(view_idx) {
            self.decode(view_idx)?;
            let image = MappingImage {
                pixels: &self.decoded,
                stride_bytes: self.native.width as usize * self.channels,
                format: self.source.pixel_format(),
            };
            self.views[slot] = shrink(&image, &self.native, &camera, &mut self.kept[place.clone()]).then_some(view_idx);
        }
        Ok((camera, &self.kept[place]))
    }

    fn decode(&mut self, view_idx: usize) -> Result<(), S::Error> {
        if self.decoded_idx != Some(view_idx) {
            self.decoded_idx = None;
            self.source.read(view_idx, &mut self.decoded)?;
            self.decoded_idx = Some(view_idx);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use image::{GrayImage, Luma};

    #[test]
    fn a_small_memory_gives_the_same_images() {
        let folder = tempfile::tempdir().expect("a folder");
        let paths = (0..3u8).map(|k| {
            let path = folder.path().join(format!("{k}.png"));
            GrayImage::from_fn(8, 4, |x, _| Luma([40 * k + x as u8])).save(&path).expect("an image");
            path
        });
        let paths: Vec<_> = paths.collect();
        let native = Pinhole { width: 8, height: 4, fx: 8.0, fy: 8.0, cx: 4.0, cy: 2.0 };
        for kept_bytes in [0, 64, 1 << 10] {
            let list = ImageList::open(paths.clone()).expect("three images");
            let mut images = TrainingImages::new(list, native, kept_bytes);
            for (view_idx, resolution) in [(0, 0.5), (2, 0.5), (0, 0.5), (1, 1.0), (2, 0.25), (2, 1.0), (0, 1.0)] {
                let (camera, pixels) = images.at(view_idx, resolution).expect("an image");
                let step = (1.0 / resolution) as usize;
                assert_eq!((camera.width as usize, pixels.len()), (8 / step, 32 / step / step));
                let mean = 40 * view_idx + (step - 1).div_ceil(2);
                assert_eq!(usize::from(pixels[0]), mean, "view {view_idx} at {resolution}, {kept_bytes} bytes");
            }
        }
    }
}
