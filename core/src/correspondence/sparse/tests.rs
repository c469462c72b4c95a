use super::*;
use crate::correspondence::testing::{Case, HEIGHT, PLAIN, WIDTH, check_matches, pyramid_of, right_tracks};
use crate::features::testing::Scene;
use std::vec;
use std::vec::Vec;

struct Memory {
    half_step: Vec<u8>,
    corners: Vec<Corner>,
    keyframe: Vec<Feature>,
    current: Vec<Feature>,
    nearest: Vec<Nearest>,
    matches: Vec<FeatureMatch>,
}

impl Memory {
    fn new(width: usize, height: usize, n: usize) -> Self {
        Self {
            half_step: vec![0xAA; half_step_bytes(width, height)],
            corners: vec![Corner::NONE; n.div_ceil(2)],
            keyframe: vec![Feature::NONE; n],
            current: vec![Feature::NONE; n],
            nearest: vec![Nearest::NONE; 2 * n],
            matches: vec![FeatureMatch::default(); n],
        }
    }

    fn matcher(&mut self, simd: SimdLevel) -> Result<DescriptorMatcher<'_>, DescriptorStorageTooSmall> {
        let storage = DescriptorStorage {
            half_step: &mut self.half_step,
            corners: &mut self.corners,
            keyframe: &mut self.keyframe,
            current: &mut self.current,
            nearest: &mut self.nearest,
            matches: &mut self.matches,
        };
        DescriptorMatcher::new(simd, DescriptorMatcherSettings::STANDARD, [WIDTH, HEIGHT], storage)
    }
}

const FEATURES: usize = 2000;

/// Matches of the first image, as keyframe `ordinals[i]`, with `images[i]`; the last call's.
fn matches_of(simd: SimdLevel, first: &[u8], images: &[(u32, &[u8])]) -> Vec<PixelMatch> {
    let mut memory = Memory::new(WIDTH, HEIGHT, FEATURES);
    let mut matcher = memory.matcher(simd).expect("sized");
    let mut bytes = [Vec::new(), Vec::new()];
    let [a, b] = &mut bytes;
    let keyframe = pyramid_of(first, WIDTH, HEIGHT, a);
    let mut matches = Vec::new();
    for (ordinal, image) in images {
        matches = vec![PixelMatch::default(); FEATURES];
        let pair = ImagePair {
            keyframe: &keyframe,
            keyframe_ordinal: *ordinal,
            current: &pyramid_of(image, WIDTH, HEIGHT, b),
        };
        let n = matcher.match_pair(&pair, &mut matches);
        matches.truncate(n);
    }
    matches
}

fn check(case: Case, lk_fails: bool) {
    let images = case.images();
    let matches = matches_of(SimdLevel::new(), &images[0], &[(7, &images[1])]);
    let (n_right, n_tracks) = (check_matches(&case, &matches), right_tracks(&case, &images));
    assert!(!lk_fails || 2 * n_tracks < n_right, "{}: {n_tracks} tracks are right, {n_right} matches", case.name);
}

#[test]
fn turns_zooms_and_wide_baselines_are_survived() {
    check(Case { median_max_px: 0.1, ..PLAIN }, false);
    let some = Case { n_min: 150, right_min: 0.97, median_max_px: 0.2, ..PLAIN };
    check(Case { name: "a turn of 30 deg", turn_rad: 0.52, ..some }, true);
    check(Case { name: "a zoom of 1.4", zoom: 1.4, ..some }, true);
    check(Case { name: "a zoom of 0.7", zoom: 0.7, ..some }, true);
    check(Case { name: "a zoom of 1.2 and a turn", zoom: 1.2, turn_rad: -0.3, ..some }, true);
    check(Case { name: "a shift of 300 px", motion_px: [300.0, -40.0], ..some }, true);
    check(Case { name: "a tenth of the light", gain: 0.1, noise: 0.5, ..some }, true);
    let noisy = Case { contrast: 0.5, noise: 8.0, motion_px: [60.0, 9.0], median_max_px: 0.4, ..some };
    check(Case { name: "noise", n_min: 80, ..noisy }, true);
}

#[test]
fn pictures_of_different_things_have_next_to_no_matches() {
    let image = |seed: u64| Scene { seed, ..Scene::textured(WIDTH, HEIGHT) }.image([0.0, 0.0]);
    let flat = vec![90; WIDTH * HEIGHT];
    let n = matches_of(SimdLevel::new(), &image(1), &[(0, &image(2))]).len();
    assert!(n <= 3, "{n} matches");
    assert_eq!(matches_of(SimdLevel::new(), &image(1), &[(0, &flat)]), []);
}

#[test]
fn the_keyframe_is_described_once_and_every_simd_level_gives_the_same_bits() {
    let [first, second] = Case { zoom: 1.1, noise: 3.0, ..PLAIN }.images();
    let once = matches_of(SimdLevel::new(), &first, &[(3, &second)]);
    assert!(once.len() > 100);
    assert_eq!(once, matches_of(SimdLevel::new(), &first, &[(3, &first), (3, &second)]));
    assert_eq!(once, matches_of(SimdLevel::new(), &first, &[(2, &first), (3, &second)]));
    assert_eq!(once, matches_of(SimdLevel::Scalar, &first, &[(3, &second)]));

    // What is kept belongs to the ordinal, not to the picture.
    let mut memory = Memory::new(WIDTH, HEIGHT, FEATURES);
    let mut matcher = memory.matcher(SimdLevel::new()).expect("sized");
    let mut bytes = [Vec::new(), Vec::new()];
    let [a, b] = &mut bytes;
    let [one, other] = [pyramid_of(&first, WIDTH, HEIGHT, a), pyramid_of(&second, WIDTH, HEIGHT, b)];
    let mut matches = vec![PixelMatch::default(); 10];
    let mut kept = |keyframe, keyframe_ordinal| {
        matcher.match_pair(&ImagePair { keyframe, keyframe_ordinal, current: &one }, &mut matches);
        matcher.keyframe_features()[0]
    };
    let of_one = kept(&one, 1);
    assert_eq!(kept(&other, 1), of_one);
    assert_ne!(kept(&other, 2), of_one);
}

#[test]
fn storage_that_is_too_short_is_refused_with_its_numbers() {
    let mut memory = Memory::new(WIDTH, HEIGHT, 100);
    memory.nearest.truncate(199);
    let problem = memory.matcher(SimdLevel::new()).map(|_| ()).expect_err("too short");
    assert_eq!(problem, DescriptorStorageTooSmall { what: "nearest", found: 199, needed: 200 });
}
