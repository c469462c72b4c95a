use super::*;
use crate::correspondence::ImagePair;
use crate::correspondence::testing::{Case, HEIGHT, PLAIN, WIDTH, check_matches, pyramid_of, right_tracks};
use crate::features::testing::Scene;
use crate::math::Rng;
use std::vec;
use std::vec::Vec;

struct Memory {
    volume: Vec<u8>,
    pooled: Vec<u8>,
    planes: Vec<f32>,
    nodes: Vec<DenseNode>,
    moved_nodes: Vec<DenseNode>,
}

impl Memory {
    fn new(capacities: &DenseCapacities) -> Self {
        Self {
            volume: vec![0xAA; capacities.volume_bytes()],
            pooled: vec![0xAA; capacities.volume_bytes()],
            planes: vec![f32::NAN; capacities.planes()],
            nodes: vec![DenseNode::NONE; capacities.nodes()],
            moved_nodes: vec![DenseNode::NONE; capacities.nodes()],
        }
    }

    fn storage(&mut self) -> DenseStorage<'_> {
        DenseStorage {
            volume: &mut self.volume,
            pooled: &mut self.pooled,
            planes: &mut self.planes,
            nodes: &mut self.nodes,
            moved_nodes: &mut self.moved_nodes,
        }
    }
}

/// Matches of two images of the same size.
fn matches_of(simd: SimdLevel, images: [&[u8]; 2], width: usize, height: usize, n: usize) -> Vec<PixelMatch> {
    let mut bytes = [Vec::new(), Vec::new()];
    let [first, second] = &mut bytes;
    let keyframe = pyramid_of(images[0], width, height, first);
    let current = pyramid_of(images[1], width, height, second);
    let capacities = DenseCapacities { width, height };
    let mut memory = Memory::new(&capacities);
    let mut matcher =
        DenseMatcher::new(simd, DenseSettings::STANDARD, capacities, memory.storage()).expect("asked for its size");
    let mut matches = vec![PixelMatch::default(); n];
    let pair = ImagePair { keyframe: &keyframe, keyframe_ordinal: 0, current: &current };
    let n_found = matcher.match_pair(&pair, &mut matches);
    matches.truncate(n_found);
    matches
}

fn check(case: Case, lk_fails: bool) {
    let images = case.images();
    let matches = matches_of(SimdLevel::new(), [&images[0], &images[1]], WIDTH, HEIGHT, 800);
    let (n_right, n_tracks) = (check_matches(&case, &matches), right_tracks(&case, &images));
    assert!(!lk_fails || 4 * n_tracks < n_right, "{}: {n_tracks} tracks are right, {n_right} matches", case.name);
}

#[test]
fn a_small_motion_is_found_to_a_fraction_of_a_pixel() {
    check(PLAIN, false);
    let moved = Case { zoom: 1.05, turn_rad: 0.02, motion_px: [8.0, 3.0], ..PLAIN };
    check(Case { name: "zoom, turn and shift", ..moved }, false);
    // The bias is 30 after the middle grey has been doubled.
    let bright = Case { gain: 2.0, bias: 30.0 - 128.0, contrast: 0.5, ..moved };
    check(Case { name: "gain 2, bias 30", median_max_px: 0.1, n_min: 250, ..bright }, false);
}

#[test]
fn it_answers_where_tracks_break() {
    let noisy = Case { contrast: 0.25, noise: 10.0, zoom: 1.05, turn_rad: 0.02, median_max_px: 0.3, ..PLAIN };
    check(Case { name: "noise of 10 on a quarter of the contrast", n_min: 300, ..noisy }, true);
    let dark = Case { gain: 0.1, noise: 1.0, median_max_px: 0.2, ..PLAIN };
    check(Case { name: "a tenth of the light", ..dark }, true);
    let far = Case { motion_px: [100.0, -20.0], ..PLAIN };
    check(Case { name: "a shift of 100 px", ..far }, true);
    check(Case { name: "a shift of 100 px in noise", noise: 10.0, contrast: 0.5, median_max_px: 0.2, ..far }, true);
    check(Case { name: "a zoom of 1.4", zoom: 1.4, n_min: 150, median_max_px: 0.15, ..PLAIN }, true);
    let blurred = Case { blur_px: 15, motion_px: [60.0, 5.0], median_max_px: 0.5, ..PLAIN };
    check(Case { name: "a blur of 15 px", n_min: 100, right_min: 0.95, ..blurred }, true);
}

#[test]
fn pictures_of_different_things_have_next_to_no_matches() {
    let image = |seed: u64| Scene { seed, ..Scene::textured(WIDTH, HEIGHT) }.image([0.0, 0.0]);
    let flat = vec![90; WIDTH * HEIGHT];
    let mut rng = Rng::new(1, 1, 1);
    let noise: Vec<u8> = (0..WIDTH * HEIGHT).map(|_| 100 + rng.below(40) as u8).collect();
    let one = image(1);
    for (name, second, most) in [("another scene", image(2), 3), ("nothing", flat.clone(), 0), ("noise", noise, 0)] {
        let n = matches_of(SimdLevel::new(), [&one, &second], WIDTH, HEIGHT, 800).len();
        assert!(n <= most, "{name}: {n} matches");
    }
    assert_eq!(matches_of(SimdLevel::new(), [&flat, &flat], WIDTH, HEIGHT, 800), []);
}

#[test]
fn every_simd_level_gives_the_same_bits_and_a_full_slice_keeps_the_most_confident() {
    let images = Case { noise: 5.0, zoom: 1.1, ..PLAIN }.images();
    let all = matches_of(SimdLevel::new(), [&images[0], &images[1]], WIDTH, HEIGHT, 800);
    assert_eq!(all, matches_of(SimdLevel::Scalar, [&images[0], &images[1]], WIDTH, HEIGHT, 800));
    let fewer = matches_of(SimdLevel::new(), [&images[0], &images[1]], WIDTH, HEIGHT, 50);
    assert_eq!(fewer, all[..50]);
}

#[test]
fn images_that_do_not_fit_are_refused() {
    let small = DenseCapacities { width: 320, height: 200 };
    let mut memory = Memory::new(&small);
    let larger = DenseCapacities { width: 350, ..small };
    let refused = DenseMatcher::new(SimdLevel::new(), DenseSettings::STANDARD, larger, memory.storage());
    let problem = refused.map(|_| ()).expect_err("too small");
    assert_eq!((problem.what, problem.found), ("volume", small.volume_bytes()));
    assert_eq!(problem.needed, larger.volume_bytes());

    let mut matcher =
        DenseMatcher::new(SimdLevel::new(), DenseSettings::STANDARD, small, memory.storage()).expect("fits");
    let mut bytes = [Vec::new(), Vec::new(), Vec::new()];
    let [a, b, c] = &mut bytes;
    let one = pyramid_of(&vec![9; 320 * 200], 320, 200, a);
    let other = pyramid_of(&vec![9; 320 * 180], 320, 180, b);
    let large = pyramid_of(&vec![9; 350 * 200], 350, 200, c);
    let mut matches = [PixelMatch::default(); 4];
    for (keyframe, current) in [(&one, &other), (&large, &large)] {
        assert_eq!(matcher.match_pair(&ImagePair { keyframe, keyframe_ordinal: 0, current }, &mut matches), 0);
    }
}
