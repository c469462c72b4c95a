use super::*;
use crate::features::testing::{Scene, distance, pyramid_of};
use std::vec::Vec;

const SETTINGS: LkSettings = LkSettings::STANDARD;

/// Largest distance from the truth of points on a grid, all of which must be found.
#[track_caller]
fn worst_px(scene: &Scene, motion_px: [f32; 2], guess_px: [f32; 2], settings: &LkSettings) -> f32 {
    let (mut a, mut b) = (Vec::new(), Vec::new());
    let source = pyramid_of(scene, [0.0, 0.0], &mut a);
    let target = pyramid_of(scene, motion_px, &mut b);
    let mut flows: Vec<Flow> = (0..30)
        .map(|i| [0.3 * scene.width as f32 + 11.7 * (i % 6) as f32, 0.3 * scene.height as f32 + 13.3 * (i / 6) as f32])
        .map(|px| Flow::new(px, [px[0] + guess_px[0], px[1] + guess_px[1]]))
        .collect();
    track_there_and_back(SimdLevel::new(), &source, &target, settings, &mut flows);
    let error_px = |flow: &Flow| {
        assert!(flow.verdict.is_found(), "{flow:?}");
        distance(flow.target_px, [flow.source_px[0] + motion_px[0], flow.source_px[1] + motion_px[1]])
    };
    flows.iter().map(error_px).fold(0.0, f32::max)
}

#[test]
fn known_shifts_are_found_to_a_fraction_of_a_pixel() {
    let scene = Scene::textured(320, 260);
    for motion_px in [[0.0, 0.0], [0.5, 0.25], [-0.37, 0.81], [3.2, -2.6], [-14.3, 9.7], [17.4, -8.9]] {
        let error_px = worst_px(&scene, motion_px, [0.0, 0.0], &SETTINGS);
        assert!(error_px < 0.03, "{motion_px:?}: {error_px} px");
    }
    let one_level = LkSettings { n_levels: 1, ..SETTINGS };
    let error_px = worst_px(&scene, [31.3, -22.2], [30.0, -21.0], &one_level);
    assert!(error_px < 0.03, "with a guess and one level: {error_px} px");
}

#[test]
fn a_change_of_exposure_does_not_move_points() {
    let scene = Scene { target_gain: 0.7, target_bias: 40.0, ..Scene::textured(200, 160) };
    let error_px = worst_px(&scene, [2.4, -1.3], [0.0, 0.0], &SETTINGS);
    assert!(error_px < 0.03, "{error_px} px");
}

#[track_caller]
fn verdict(scene: &Scene, target: &Scene, px: [f32; 2], guess_px: [f32; 2]) -> LkVerdict {
    let (mut a, mut b) = (Vec::new(), Vec::new());
    let source = pyramid_of(scene, [0.0, 0.0], &mut a);
    let target = pyramid_of(target, [0.0, 0.0], &mut b);
    let mut flows = [Flow::new(px, guess_px)];
    track_there_and_back(SimdLevel::new(), &source, &target, &SETTINGS, &mut flows);
    flows[0].verdict
}

#[test]
fn each_way_to_fail_has_its_verdict() {
    let scene = Scene::textured(200, 160);
    let flat = Scene { contrast: 0.0, ..scene };
    let other = Scene { seed: 99, ..scene };
    let center = [100.0, 80.0];
    assert!(matches!(verdict(&flat, &flat, center, center), LkVerdict::Flat { .. }));
    for px in [[1.0, 80.0], [199.0, 80.0], [100.0, -5.0], [f32::NAN, 80.0], [100.0, f32::INFINITY]] {
        assert_eq!(verdict(&scene, &scene, px, center), LkVerdict::LeftImage, "from {px:?}");
    }
    for guess in [[f32::NAN, 1.0], [1e30, 80.0]] {
        assert!(!verdict(&scene, &scene, center, guess).is_found(), "expected at {guess:?}");
    }
    let changed = verdict(&scene, &other, center, center);
    assert!(matches!(changed, LkVerdict::Different { .. } | LkVerdict::Inconsistent { .. }), "{changed:?}");
    assert!(verdict(&scene, &scene, center, center).is_found());
}

#[test]
fn a_covered_point_is_given_up_and_its_neighbors_are_not() {
    let scene = Scene::textured(200, 160);
    let covered = Scene { cover: Some([80, 60, 120, 100]), ..scene };
    assert!(!verdict(&scene, &covered, [100.0, 80.0], [100.0, 80.0]).is_found());
    assert!(verdict(&scene, &covered, [150.0, 80.0], [150.0, 80.0]).is_found());
}

#[test]
fn every_simd_level_gives_the_same_bits() {
    let scene = Scene::textured(200, 160);
    let (mut a, mut b) = (Vec::new(), Vec::new());
    let source = pyramid_of(&scene, [0.0, 0.0], &mut a);
    let target = pyramid_of(&scene, [3.7, -2.2], &mut b);
    let start: Vec<Flow> = (0..200)
        .map(|i| [(i * 37 % 200) as f32 + 0.3, (i * 53 % 160) as f32 + 0.6])
        .map(|px| Flow::new(px, px))
        .collect();
    let run = |simd| {
        let mut flows = start.clone();
        track_there_and_back(simd, &source, &target, &SETTINGS, &mut flows);
        flows
    };
    let scalar = run(SimdLevel::Scalar);
    assert!(scalar.iter().any(|f| f.verdict.is_found()) && scalar.iter().any(|f| !f.verdict.is_found()));
    assert_eq!(scalar, run(SimdLevel::new()));
}

#[test]
fn images_smaller_than_the_window_are_searched_on_the_full_image_only() {
    let scene = Scene::textured(28, 26);
    let found = verdict(&scene, &scene, [14.0, 13.0], [14.3, 12.8]);
    assert!(found.is_found(), "{found:?}");
}
