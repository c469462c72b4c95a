//! A rendered picture in memory that is taken once.

use crate::splat::RenderTarget;

/// Color, depth and transmittance of one view; 20 bytes per pixel.
#[derive(Debug, Clone)]
pub struct Picture {
    width: u32,
    height: u32,
    rgb: Vec<[f32; 3]>,
    depth_m: Vec<f32>,
    transmittance: Vec<f32>,
}

impl Picture {
    /// A black picture.
    pub fn new(width: u32, height: u32) -> Self {
        let n_pixels = width as usize * height as usize;
        Self {
            width,
            height,
            rgb: vec![[0.0; 3]; n_pixels],
            depth_m: vec![0.0; n_pixels],
            transmittance: vec![1.0; n_pixels],
        }
    }

    /// Colors row by row, as rendered: not clamped.
    pub fn rgb(&self) -> &[[f32; 3]] {
        &self.rgb
    }

    /// Colors row by row as a display shows them, in [0, 1]: those of a grey camera's map are the mean of the channels.
    pub fn shown(&self, is_grey: bool) -> impl Iterator<Item = [f32; 3]> {
        // Clamped channel by channel first, as a display would do before anybody sees a grey.
        let clamped = self.rgb.iter().map(|rgb| rgb.map(|channel| channel.clamp(0.0, 1.0)));
        clamped.map(move |rgb| if is_grey { [rgb.iter().sum::<f32>() / 3.0; 3] } else { rgb })
    }

    /// Where a backend puts it.
    pub fn target(&mut self) -> RenderTarget<'_> {
        RenderTarget { rgb: &mut self.rgb, depth_m: &mut self.depth_m, transmittance: &mut self.transmittance }
    }

    /// The picture as a display shows it.
    pub fn to_image(&self) -> image::RgbImage {
        let pixel = |x: u32, y: u32| {
            let rgb = self.rgb.get(y as usize * self.width as usize + x as usize).copied().unwrap_or_default();
            image::Rgb(rgb.map(|channel| (channel.clamp(0.0, 1.0) * 255.0).round() as u8))
        };
        image::RgbImage::from_fn(self.width, self.height, pixel)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grey_is_the_mean_of_what_is_seen() {
        let mut picture = Picture::new(2, 1);
        picture.target().rgb[1] = [-0.5, 0.5, 1.5];
        assert_eq!(picture.shown(false).collect::<Vec<_>>(), [[0.0; 3], [0.0, 0.5, 1.0]]);
        assert_eq!(picture.shown(true).collect::<Vec<_>>(), [[0.0; 3], [0.5; 3]]);
    }

    #[test]
    fn a_display_clamps_and_rounds() {
        let mut picture = Picture::new(3, 2);
        picture.target().rgb[4] = [-0.5, 0.5, 1.5];
        let shown = picture.to_image();
        assert_eq!(shown.get_pixel(1, 1).0, [0, 128, 255]);
        assert_eq!(shown.get_pixel(0, 0).0, [0; 3]);
    }
}
