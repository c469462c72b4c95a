use super::*;
use crate::features::hamming::distance;
use crate::features::testing::Scene;
use crate::frame::pyramid::bytes_needed;
use std::vec;
use std::vec::Vec;

const SIZE: [usize; 2] = [400, 300];

/// The feature at the middle of a scene that has been turned, and one beside it.
fn middle_of(turn_rad: f32) -> [Feature; 2] {
    let (sin, cos) = turn_rad.sin_cos();
    // Scenes are turned once they move: by nothing that can be seen.
    let scene = Scene { seed: 3, shape: [[cos, -sin], [sin, cos]], ..Scene::textured(SIZE[0], SIZE[1]) };
    let pixels = scene.image([1e-3, 0.0]);
    let mut bytes = vec![0; bytes_needed(SIZE[0], SIZE[1], 1)];
    let mut pyramid = Pyramid::new(&mut bytes, SIZE[0], SIZE[1], 1).expect("asked for its size");
    pyramid.build(ImageView::new(&pixels, SIZE[0], SIZE[1], SIZE[0]).expect("sized")).expect("same size");
    let at = |pixel| Corner { pixel, min_eigenvalue: 1.0 };
    let corners = [at([200.0, 150.0]), at([240.0, 150.0]), at([399.5, 150.0]), at([700.0, 3.0])];
    let mut features = [Feature::NONE; 4];
    let level = pyramid.level(0).expect("one level");
    let n = describe(SimdLevel::new(), &level, 2.0, &corners, &mut features);
    // The third one's surroundings end a pixel beyond the margin, the fourth one's are outside.
    assert_eq!(n, 2, "{:?}", &features[..n]);
    let mut scalar = [Feature::NONE; 4];
    assert_eq!(describe(SimdLevel::Scalar, &level, 2.0, &corners, &mut scalar), n);
    assert_eq!(scalar, features);
    [features[0], features[1]]
}

#[test]
fn a_turned_corner_keeps_its_descriptor_and_turns_its_direction() {
    let [here, beside] = middle_of(0.0);
    assert_eq!((here.pixel, here.scale), ([400.0, 300.0], 2.0));
    let apart = distance(&here.descriptor, &beside.descriptor);
    assert!(apart > 80, "different places differ in {apart} bits only");
    for turn_rad in [0.3f32, -0.52, 1.5, 3.0] {
        let [turned, _] = middle_of(turn_rad);
        let bits = distance(&here.descriptor, &turned.descriptor);
        assert!(bits < 40, "turned by {turn_rad} rad: {bits} bits");
        let cos = here.direction[0] * turned.direction[0] + here.direction[1] * turned.direction[1];
        let sin = here.direction[0] * turned.direction[1] - here.direction[1] * turned.direction[0];
        let off_rad = (sin.atan2(cos) - turn_rad).abs();
        assert!(off_rad < 0.1, "turned by {turn_rad} rad, found {}", sin.atan2(cos));
    }
}

#[test]
fn features_of_all_sizes_fill_the_storage_and_no_more() {
    let pixels = Scene::textured(SIZE[0], SIZE[1]).image([0.0, 0.0]);
    let mut bytes = vec![0; bytes_needed(SIZE[0], SIZE[1], 4)];
    let mut pyramid = Pyramid::new(&mut bytes, SIZE[0], SIZE[1], 4).expect("asked for its size");
    pyramid.build(ImageView::new(&pixels, SIZE[0], SIZE[1], SIZE[0]).expect("sized")).expect("same size");
    let mut half_step = vec![0xAA; half_step_bytes(SIZE[0], SIZE[1])];
    let mut corners = vec![Corner::NONE; 50];
    let mut features = vec![Feature::NONE; 100];
    let mut extract_into = |half_step: &mut Vec<u8>, simd| {
        let mut scratch = ExtractScratch { half_step, corners: &mut corners };
        extract(simd, &pyramid, &ExtractSettings::STANDARD, &mut scratch, &mut features[..60])
    };
    assert_eq!(extract_into(&mut half_step, SimdLevel::new()), 60);
    let mut short = vec![0; half_step.len() - 1];
    assert_eq!(extract_into(&mut short, SimdLevel::new()), 0);
    let of_scale = |scale: f32| features.iter().filter(|f| f.scale == scale && f.min_eigenvalue > 0.0).count();
    let found = [HALF_STEP, 2.0, 2.0 * HALF_STEP, 4.0].map(of_scale);
    assert_eq!((found.iter().sum::<usize>(), features[60]), (60, Feature::NONE));
    assert!(found.iter().all(|&n| n >= 7), "{found:?}");
}
