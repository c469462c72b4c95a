//! The pictures of a stored map as training images.

use crate::fit::ImageSource;
use crate::map_store::{MapStoreReader, StoreError};
use kilogs_core::frame::PixelFormat;

/// Decodes the keyframes' pictures; a view's number is that of its keyframe in the map's list.
pub(super) struct StoredImages<'m> {
    map: &'m MapStoreReader,
}

impl<'m> StoredImages<'m> {
    pub(super) fn new(map: &'m MapStoreReader) -> Self {
        Self { map }
    }

    fn channels(&self) -> usize {
        if self.pixel_format() == PixelFormat::Mono8 { 1 } else { 3 }
    }
}

impl ImageSource for StoredImages<'_> {
    type Error = StoreError;

    fn bytes(&self) -> usize {
        let camera = &self.map.manifest().camera;
        camera.width as usize * camera.height as usize * self.channels()
    }

    fn pixel_format(&self) -> PixelFormat {
        // However the camera ordered its channels: a JPEG is RGB.
        match self.map.manifest().pixel_format {
            PixelFormat::Mono8 => PixelFormat::Mono8,
            _ => PixelFormat::Rgb8,
        }
    }

    fn read(&mut self, view_idx: usize, pixels: &mut [u8]) -> Result<(), StoreError> {
        let wrong = |reason: String| StoreError::Image { path: self.map.folder().to_owned(), reason };
        let keyframe =
            self.map.keyframes().get(view_idx).ok_or_else(|| wrong(format!("there is no view {view_idx}")))?;
        let image = self.map.read_image(keyframe)?;
        let camera = &self.map.manifest().camera;
        if image.dimensions() != (camera.width, camera.height) {
            let frame = keyframe.frame_index;
            return Err(wrong(format!("the picture of frame {frame} has another size than the camera")));
        }
        if self.channels() == 3 {
            pixels.copy_from_slice(image.as_raw());
        } else {
            pixels.iter_mut().zip(image.pixels()).for_each(|(grey, pixel)| *grey = pixel.0[1]);
        }
        Ok(())
    }
}
