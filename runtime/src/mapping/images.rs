//! Keyframe images at mapping resolution: a ring of fixed size, oldest overwritten.

use super::shrink::{luma, shrink};
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::frame::PixelFormat;
use nalgebra::Vector2;

/// A camera image as it was delivered.
#[derive(Debug, Clone, Copy)]
pub struct MappingImage<'a> {
    /// Rows of pixels.
    pub pixels: &'a [u8],
    /// Bytes between the starts of two rows.
    pub stride_bytes: usize,
    /// Layout of a pixel: one byte of grey or three of color.
    pub format: PixelFormat,
}

/// A keyframe whose image is kept.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KeptKeyframe {
    /// Ordinal among the keyframes.
    pub ordinal: u32,
    /// Where the camera was.
    pub world_from_camera: Rigid,
}

/// The images of the newest keyframes.
#[derive(Debug)]
pub struct KeyframeImages {
    native: Pinhole,
    camera: Pinhole,
    channels: usize,
    kept: Box<[Option<KeptKeyframe>]>,
    pixels: Box<[u8]>,
    luma: Box<[u8]>,
    n_pushed: usize,
}

impl KeyframeImages {
    /// Room for `capacity` images of `camera`'s size with one or three channels.
    pub fn new(native: Pinhole, camera: Pinhole, channels: usize, capacity: usize) -> Self {
        let n_pixels = camera.width as usize * camera.height as usize;
        Self {
            native,
            camera,
            channels,
            kept: vec![None; capacity.max(1)].into(),
            pixels: vec![0; capacity.max(1) * n_pixels * channels].into(),
            luma: vec![0; capacity.max(1) * n_pixels].into(),
            n_pushed: 0,
        }
    }

    /// Intrinsics at mapping resolution.
    pub fn camera(&self) -> &Pinhole {
        &self.camera
    }

    /// Intrinsics of the camera's own images.
    pub fn native(&self) -> &Pinhole {
        &self.native
    }

    /// Bytes per pixel that are kept.
    pub fn channels(&self) -> usize {
        self.channels
    }

    fn n_pixels(&self) -> usize {
        self.camera.width as usize * self.camera.height as usize
    }

    /// Keeps an image in place of the oldest; false (and nothing kept) when its bytes do not fit its size.
    pub fn push(&mut self, keyframe: KeptKeyframe, image: &MappingImage<'_>) -> bool {
        let (n, channels) = (self.n_pixels(), self.channels);
        let slot = self.n_pushed % self.kept.len();
        let pixels = &mut self.pixels[slot * n * channels..(slot + 1) * n * channels];
        self.kept[slot] = None;
        if !shrink(image, &self.native, &self.camera, pixels) {
            return false;
        }
        let grey = &mut self.luma[slot * n..(slot + 1) * n];
        for (grey, pixel) in grey.iter_mut().zip(pixels.chunks_exact(channels)) {
            *grey = luma(pixel);
        }
        self.kept[slot] = Some(keyframe);
        self.n_pushed += 1;
        true
    }

    /// Moves the keyframes whose images are there.
    pub fn move_keyframes(&mut self, moved: impl Fn(u32, &Rigid) -> Rigid) {
        for keyframe in self.kept.iter_mut().flatten() {
            keyframe.world_from_camera = moved(keyframe.ordinal, &keyframe.world_from_camera);
        }
    }

    /// Keyframes whose images are there.
    pub fn len(&self) -> usize {
        self.n_pushed.min(self.kept.len())
    }

    /// The keyframe `age` places before the newest, with its pixels and its brightness.
    pub fn newest(&self, age: usize) -> Option<KeptImage<'_>> {
        let nth = self.n_pushed.checked_sub(age + 1).filter(|_| age < self.kept.len())?;
        let slot = nth % self.kept.len();
        let (n, channels) = (self.n_pixels(), self.channels);
        Some(KeptImage {
            keyframe: self.kept[slot]?,
            pixels: &self.pixels[slot * n * channels..(slot + 1) * n * channels],
            luma: &self.luma[slot * n..(slot + 1) * n],
            place: slot,
        })
    }
}

/// One kept image.
#[derive(Debug, Clone, Copy)]
pub struct KeptImage<'a> {
    /// Which keyframe.
    pub keyframe: KeptKeyframe,
    /// Grey or RGB bytes, row by row.
    pub pixels: &'a [u8],
    /// Brightness, row by row.
    pub luma: &'a [u8],
    /// Its place in the ring, which is also that of its exposure in the splat backend.
    pub place: usize,
}

/// Index of the pixel that contains a place on the image plane.
pub(super) fn pixel_index(camera: &Pinhole, place_px: &Vector2<f64>) -> Option<usize> {
    let is_inside = |place_px: f64, size_px: u32| (0.0..f64::from(size_px)).contains(&place_px);
    let inside = is_inside(place_px.x, camera.width) && is_inside(place_px.y, camera.height);
    inside.then(|| place_px.y as usize * camera.width as usize + place_px.x as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { width: 2, height: 1, fx: 2.0, fy: 2.0, cx: 1.0, cy: 0.5 };

    #[test]
    fn the_oldest_image_leaves_first_and_a_refused_one_does_not_count() {
        let mut images = KeyframeImages::new(CAMERA, CAMERA, 1, 2);
        for ordinal in 1..=3u8 {
            let keyframe = KeptKeyframe { ordinal: ordinal.into(), world_from_camera: Rigid::identity() };
            let pixels = [ordinal * 10, 5];
            assert!(
                images.push(keyframe, &MappingImage { pixels: &pixels, stride_bytes: 2, format: PixelFormat::Mono8 })
            );
        }
        let ordinal = |age| images.newest(age).map(|kept| (kept.keyframe.ordinal, kept.luma[0]));
        assert_eq!([ordinal(0), ordinal(1), ordinal(2)], [Some((3, 30)), Some((2, 20)), None]);
        let keyframe = KeptKeyframe { ordinal: 4, world_from_camera: Rigid::identity() };
        assert!(!images.push(keyframe, &MappingImage { pixels: &[1], stride_bytes: 2, format: PixelFormat::Mono8 }));
        assert_eq!((images.len(), images.newest(0).map(|kept| kept.keyframe.ordinal)), (2, Some(3)));
    }
}
