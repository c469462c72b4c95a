//! Pictures that differ in known ways, for the tests of all matchers.

use super::PixelMatch;
use crate::features::SimdLevel;
use crate::features::corners::{self, Corner, CornerSettings};
use crate::features::lk::{self, Flow, LkSettings};
use crate::features::testing::{Scene, distance};
use crate::frame::pyramid::bytes_needed;
use crate::frame::{ImageView, Pyramid};
use crate::math::Rng;
use std::vec;
use std::vec::Vec;

pub const WIDTH: usize = 1241;
pub const HEIGHT: usize = 376;

pub fn pyramid_of<'m>(pixels: &[u8], width: usize, height: usize, bytes: &'m mut Vec<u8>) -> Pyramid<'m> {
    bytes.resize(bytes_needed(width, height, 4), 0);
    let mut pyramid = Pyramid::new(bytes, width, height, 4).expect("asked for its size");
    pyramid.build(ImageView::new(pixels, width, height, width).expect("sized")).expect("same size");
    pyramid
}

/// How the second image differs from the first.
#[derive(Clone, Copy)]
pub struct Case {
    pub name: &'static str,
    pub motion_px: [f32; 2],
    pub zoom: f32,
    pub turn_rad: f32,
    /// Both images: contrast about the middle grey.
    pub contrast: f32,
    pub gain: f32,
    pub bias: f32,
    pub noise: f32,
    pub blur_px: usize,
    /// At least so many matches of which so large a share is right, and the median of all errors.
    pub n_min: usize,
    pub right_min: f32,
    pub median_max_px: f32,
}

pub const PLAIN: Case = Case {
    name: "nothing",
    motion_px: [3.3, -1.7],
    zoom: 1.0,
    turn_rad: 0.0,
    contrast: 1.0,
    gain: 1.0,
    bias: 0.0,
    noise: 0.0,
    blur_px: 1,
    n_min: 300,
    right_min: 0.99,
    median_max_px: 0.05,
};

/// A match is right when it is this close to the truth.
pub const RIGHT_PX: f32 = 2.0;

impl Case {
    fn scene(&self) -> Scene {
        let (sin, cos) = (self.zoom * self.turn_rad.sin(), self.zoom * self.turn_rad.cos());
        Scene { seed: 5, shape: [[cos, -sin], [sin, cos]], ..Scene::textured(WIDTH, HEIGHT) }
    }

    pub fn images(&self) -> [Vec<u8>; 2] {
        let scene = self.scene();
        let mut rng = Rng::new(3, 1, 4);
        let mut degrade = |pixels: Vec<u8>, gain: f32, bias: f32, blur_px: usize| -> Vec<u8> {
            let half = blur_px / 2;
            let grey = |i: usize| {
                let (x, row) = (i % WIDTH, i / WIDTH * WIDTH);
                let run = &pixels[row + x.saturating_sub(half)..row + (x + half + 1).min(WIDTH)];
                let blurred = run.iter().map(|&p| f32::from(p)).sum::<f32>() / run.len() as f32;
                // The sum of twelve uniform numbers has variance 1.
                let normal: f32 = (0..12).map(|_| rng.unit_f32()).sum::<f32>() - 6.0;
                let value = gain * (128.0 + self.contrast * (blurred - 128.0)) + bias + self.noise * normal;
                value.round().clamp(0.0, 255.0) as u8
            };
            (0..pixels.len()).map(grey).collect()
        };
        let first = degrade(scene.image([0.0, 0.0]), 1.0, 0.0, 1);
        [first, degrade(scene.image(self.motion_px), self.gain, self.bias, self.blur_px)]
    }

    pub fn truth_px(&self, px: [f32; 2]) -> [f32; 2] {
        let scene = self.scene();
        let ([cx, cy], [[a, b], [c, d]]) = (scene.center_px(), scene.shape);
        let (x, y) = (px[0] - cx, px[1] - cy);
        [cx + self.motion_px[0] + a * x + b * y, cy + self.motion_px[1] + c * x + d * y]
    }
}

/// Asserts what the case expects of `matches`, which have to be in order; returns how many are right.
pub fn check_matches(case: &Case, matches: &[PixelMatch]) -> usize {
    let mut errors: Vec<f32> = matches.iter().map(|m| distance(m.current_px, case.truth_px(m.keyframe_px))).collect();
    let n_right = errors.iter().filter(|&&error| error < RIGHT_PX).count();
    errors.sort_unstable_by(f32::total_cmp);
    let median_px = errors.get(errors.len() / 2).copied().unwrap_or(f32::INFINITY);
    std::println!("{}: {} matches, {n_right} right, median {median_px} px", case.name, matches.len());
    assert!(matches.len() >= case.n_min, "{}: {} matches", case.name, matches.len());
    assert!(n_right as f32 >= case.right_min * matches.len() as f32, "{}: {n_right} of {}", case.name, matches.len());
    assert!(median_px <= case.median_max_px, "{}: median {median_px} px", case.name);
    assert!(matches.windows(2).all(|pair| pair[0].confidence >= pair[1].confidence), "{}: not in order", case.name);
    n_right
}

/// Share of the tracks that plain Lucas-Kanade keeps and finds within [`RIGHT_PX`].
pub fn right_tracks(case: &Case, images: &[Vec<u8>; 2]) -> usize {
    let mut bytes = [Vec::new(), Vec::new()];
    let [first, second] = &mut bytes;
    let (keyframe, current) =
        (pyramid_of(&images[0], WIDTH, HEIGHT, first), pyramid_of(&images[1], WIDTH, HEIGHT, second));
    let mut corners = vec![Corner::NONE; 1000];
    let simd = SimdLevel::new();
    let report = corners::detect(simd, keyframe.image(), &CornerSettings::STANDARD, core::iter::empty(), &mut corners);
    let mut flows: Vec<Flow> = corners[..report.n_found].iter().map(|c| Flow::new(c.pixel, c.pixel)).collect();
    lk::track_there_and_back(simd, &keyframe, &current, &LkSettings::STANDARD, &mut flows);
    let is_right = |flow: &&Flow| distance(flow.target_px, case.truth_px(flow.source_px)) < RIGHT_PX;
    flows.iter().filter(|flow| flow.verdict.is_found()).filter(is_right).count()
}
