use super::*;
use crate::features::testing::{Scene, distance, pyramid_of};
use std::vec::Vec;

const SETTINGS: AffineSettings = AffineSettings::STANDARD;

/// Refines around the centre of an image that has been deformed about its centre.
#[track_caller]
fn refined(scene: &Scene, deformed: &Scene, motion_px: [f32; 2], start_off_px: [f32; 2]) -> AffineFlow {
    let (mut a, mut b) = (Vec::new(), Vec::new());
    let keyframe = pyramid_of(scene, [0.0, 0.0], &mut a);
    let current = pyramid_of(deformed, motion_px, &mut b);
    let center = scene.center_px();
    let start = [center[0] + motion_px[0] + start_off_px[0], center[1] + motion_px[1] + start_off_px[1]];
    let flow = AffineFlow { keyframe_px: center, placement: Placement::at(start), verdict: AffineVerdict::Pending };
    let (mut plain, mut vectorized) = ([flow], [flow]);
    refine(SimdLevel::Scalar, &keyframe, &current, &SETTINGS, &mut plain);
    refine(SimdLevel::new(), &keyframe, &current, &SETTINGS, &mut vectorized);
    let bits = |flow: &AffineFlow| (flow.verdict, flow.placement.center_px.map(f32::to_bits), flow.placement.shape);
    assert_eq!(bits(&plain[0]), bits(&vectorized[0]), "SIMD changes bits");
    plain[0]
}

#[test]
fn a_deformed_window_is_found_with_its_shape() {
    let scene = Scene::textured(200, 160);
    for shape in [
        [[1.0, 0.0], [0.0, 1.0]],
        [[1.25, 0.0], [0.0, 1.25]],
        [[1.2, 0.0], [0.0, 1.4]],
        [[0.8, 0.05], [-0.05, 0.85]],
        [[1.0, 0.2], [-0.15, 1.0]],
    ] {
        let motion_px = [3.3, -2.7];
        let deformed = Scene { shape, target_gain: 0.8, target_bias: 30.0, ..scene };
        let flow = refined(&scene, &deformed, motion_px, [0.8, -0.6]);
        assert!(matches!(flow.verdict, AffineVerdict::Placed { .. }), "{shape:?}: {flow:?}");
        let expected_px = [100.0 + motion_px[0], 80.0 + motion_px[1]];
        let error_px = distance(flow.placement.center_px, expected_px);
        assert!(error_px < 0.03, "{shape:?}: {error_px} px");
        for (found, expected) in flow.placement.shape.iter().flatten().zip(shape.iter().flatten()) {
            assert!((found - expected).abs() < 0.02, "{:?} {shape:?}", flow.placement.shape);
        }
    }
}

#[test]
fn what_is_not_there_is_not_placed() {
    let scene = Scene::textured(200, 160);
    let other = Scene { seed: 77, ..scene };
    let flat = Scene { contrast: 0.0, ..scene };
    for deformed in [&other, &flat] {
        let flow = refined(&scene, deformed, [0.0, 0.0], [0.0, 0.0]);
        assert!(!matches!(flow.verdict, AffineVerdict::Placed { .. }), "{flow:?}");
        assert_eq!(flow.placement, Placement::at([100.0, 80.0]), "left alone");
    }
    assert_eq!(refined(&flat, &scene, [0.0; 2], [0.0; 2]).verdict, AffineVerdict::Collapsed);
    let far = refined(&scene, &scene, [0.0; 2], [2.9, 2.9]);
    assert!(!matches!(far.verdict, AffineVerdict::Placed { .. }), "{far:?}");
}

#[test]
fn coordinates_that_are_no_pixels_have_left_the_image() {
    let scene = Scene::textured(200, 160);
    for off_px in [[f32::NAN, 0.0], [0.0, f32::INFINITY], [1e30, 0.0], [120.0, 0.0], [0.0, -100.0]] {
        assert_eq!(refined(&scene, &scene, [0.0; 2], off_px).verdict, AffineVerdict::LeftImage, "{off_px:?}");
    }
}
