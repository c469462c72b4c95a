//! A procedural texture whose value is known at every sub-pixel position.

use crate::frame::pyramid::bytes_needed;
use crate::frame::{ImageView, Pyramid};
use crate::math::Rng;
use std::vec::Vec;

/// Sum of plane waves of random direction and wavelength, 8 to 128 px.
#[derive(Clone, Copy, Debug)]
pub struct Scene {
    pub width: usize,
    pub height: usize,
    pub seed: u64,
    /// Standard deviation of grey values.
    pub contrast: f32,
    /// Applied to images that have moved.
    pub target_gain: f32,
    pub target_bias: f32,
    /// Linear deformation about the centre of images that have moved.
    pub shape: [[f32; 2]; 2],
    /// Rectangle (left, top, right, bottom) that shows another texture.
    pub cover: Option<[usize; 4]>,
}

impl Scene {
    pub fn textured(width: usize, height: usize) -> Self {
        Self {
            width,
            height,
            seed: 1,
            contrast: 30.0,
            target_gain: 1.0,
            target_bias: 0.0,
            shape: [[1.0, 0.0], [0.0, 1.0]],
            cover: None,
        }
    }

    pub fn center_px(&self) -> [f32; 2] {
        [0.5 * self.width as f32, 0.5 * self.height as f32]
    }

    /// The image after its content has moved by `motion_px`.
    pub fn image(&self, motion_px: [f32; 2]) -> Vec<u8> {
        let waves = self.waves(self.seed);
        let cover = self.waves(self.seed + 1000);
        let (gain, bias) = if motion_px == [0.0, 0.0] { (1.0, 0.0) } else { (self.target_gain, self.target_bias) };
        let [[a, b], [c, d]] = if motion_px == [0.0, 0.0] { [[1.0, 0.0], [0.0, 1.0]] } else { self.shape };
        let determinant = a * d - b * c;
        let [cx, cy] = self.center_px();
        let source = |x: f32, y: f32| {
            let (dx, dy) = (x - motion_px[0] - cx, y - motion_px[1] - cy);
            (cx + (d * dx - b * dy) / determinant, cy + (a * dy - c * dx) / determinant)
        };
        let mut pixels = Vec::with_capacity(self.width * self.height);
        for y in 0..self.height {
            for x in 0..self.width {
                let covered = self.cover.is_some_and(|[l, t, r, b]| (l..r).contains(&x) && (t..b).contains(&y));
                let (px, py) = source(x as f32 + 0.5, y as f32 + 0.5);
                let height: f32 = if covered { &cover } else { &waves }
                    .iter()
                    .map(|[kx, ky, phase]| (kx * px + ky * py + phase).sin())
                    .sum();
                let value = 128.0 + self.contrast * height / (waves.len() as f32 * 0.5).sqrt();
                pixels.push((gain * value + bias).round().clamp(0.0, 255.0) as u8);
            }
        }
        pixels
    }

    fn waves(&self, seed: u64) -> [[f32; 3]; 24] {
        let mut rng = Rng::new(seed, 0, 0);
        core::array::from_fn(|_| {
            let angle = rng.unit_f32() * core::f32::consts::TAU;
            let number = core::f32::consts::TAU / (8.0 * 16f32.powf(rng.unit_f32()));
            [number * angle.cos(), number * angle.sin(), rng.unit_f32() * core::f32::consts::TAU]
        })
    }
}

/// Distance of two pixels, px.
pub fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// Four-level pyramid of the scene moved by `motion_px`, in `storage`.
pub fn pyramid_of<'a>(scene: &Scene, motion_px: [f32; 2], storage: &'a mut Vec<u8>) -> Pyramid<'a> {
    storage.resize(bytes_needed(scene.width, scene.height, 4), 0);
    let mut pyramid = Pyramid::new(storage, scene.width, scene.height, 4).expect("asked for its size");
    let pixels = scene.image(motion_px);
    pyramid.build(ImageView::new(&pixels, scene.width, scene.height, scene.width).expect("sized")).expect("same size");
    pyramid
}
