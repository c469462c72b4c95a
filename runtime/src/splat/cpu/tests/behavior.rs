//! What the backend does at its limits.

use super::scenes::{K, anchors, backend, filled, read, render, view};
use crate::seal;
use crate::splat::cpu::{CpuBackend, OpenError, SimdLevel};
use crate::splat::*;
use kilogs_core::conventions::Rigid;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

fn gray_view(view: View, gray: &[u8]) -> TrainingView<'_> {
    TrainingView { view, target: TargetImage::Gray8(gray), depth: None, exposure_slot: None }
}

type Shrink = fn(&mut Capacities);
type Counter = fn(&Overflow) -> u32;

#[test]
fn what_does_not_fit_is_counted_and_the_rest_is_drawn() {
    let view = view(64, 48);
    let (headers, params) = anchors(40, 2);
    let roomy = backend(&view, &headers, &params, 2).capacities().to_owned();
    let cases: [(Shrink, Counter); 3] = [
        (|c| c.visible_gaussians = 16, |o| o.visible_gaussians),
        (|c| c.row_entries = 20, |o| o.row_entries),
        (|c| c.pairs = 30, |o| o.pairs),
    ];
    for (shrink, counter) in cases {
        let mut capacities = roomy;
        shrink(&mut capacities);
        let mut backend = filled(capacities, &headers, &params, 2);
        let picture = render(&mut backend, &view);
        assert!(counter(&picture.stats.overflow) > 0, "{:?}", picture.stats);
        assert!(picture.rgb.as_flattened().iter().all(|v| v.is_finite()));
        assert!(picture.stats.visible as usize <= capacities.visible_gaussians);
        assert!(picture.stats.row_entries as usize <= capacities.row_entries);
        assert!(picture.stats.pairs as usize <= capacities.pairs);
        let gray = vec![90; view.n_pixels()];
        for _ in 0..3 {
            let report = backend.train_step(&gray_view(view, &gray), &StepSettings::direct(0.0));
            assert!(report.loss.total.is_finite() && counter(&report.stats.overflow) > 0, "{report:?}");
        }
    }
}

#[test]
fn numbers_that_are_none_are_refused_at_the_door() {
    let view = view(32, 24);
    let (headers, params) = anchors(2, 4);
    let mut backend = backend(&view, &headers, &params, 1);
    let before = read(&backend);
    let refused = |backend: &mut CpuBackend, change: fn(&mut AnchorHeader, &mut GaussianParams)| {
        let (mut header, mut own) = (headers[0], params[..K].to_vec());
        change(&mut header, &mut own[1]);
        backend.write_anchors(&[0], &[header], &own)
    };
    assert_eq!(refused(&mut backend, |_, g| g.offset[2] = f32::NAN), 1);
    assert_eq!(refused(&mut backend, |_, g| g.opacity_logit = f32::INFINITY), 1);
    assert_eq!(refused(&mut backend, |h, _| h.position_in_keyframe_m[0] = f32::NAN), 1);
    assert_eq!(refused(&mut backend, |h, _| h.keyframe_row = 9), 1);
    assert_eq!(refused(&mut backend, |h, _| h.n_gaussians = K as u8 + 1), 1);
    assert_eq!(backend.write_anchors(&[7], &headers[..1], &params[..K]), 1, "no such slot");
    assert_eq!(read(&backend), before);
    assert_eq!(refused(&mut backend, |_, _| ()), 0);
    assert_eq!(backend.retire_anchors(&[0, 7]), 1);
    assert_eq!(backend.set_keyframes(0, &[KeyframePlacement::identity(); 3]), 2);
    assert!(!backend.write_background(1, &[[0.0; 3]; BACKGROUND_TEXELS]));
    assert!(!backend.write_exposure(1, Exposure::IDENTITY));
}

#[test]
fn views_that_do_not_fit_are_refused_and_change_nothing() {
    let good = view(32, 24);
    let (headers, params) = anchors(4, 4);
    let mut backend = backend(&good, &headers, &params, 1);
    let before = read(&backend);
    let changes: [fn(&mut View); 5] = [
        |v| v.camera.width = 33,
        |v| v.camera.height = 0,
        |v| v.chunk_row = 1,
        |v| v.camera.fx = f64::NAN,
        |v| v.camera_from_map.translation.x = f64::INFINITY,
    ];
    for change in changes {
        let mut bad = good;
        change(&mut bad);
        let gray = vec![90; bad.n_pixels()];
        assert!(backend.train_step(&gray_view(bad, &gray), &StepSettings::direct(0.0)).stats.refused, "{bad:?}");
    }
    let short = vec![90; good.n_pixels() - 1];
    assert!(backend.train_step(&gray_view(good, &short), &StepSettings::direct(0.0)).stats.refused);
    assert_eq!(read(&backend), before);
}

#[test]
fn moving_a_keyframe_and_the_camera_together_changes_nothing() {
    let still = view(48, 36);
    let (headers, params) = anchors(12, 6);
    let mut backend = backend(&still, &headers, &params, 1);
    let before = render(&mut backend, &still);
    let map_from_keyframe = KeyframePlacement {
        rotation: UnitQuaternion::from_euler_angles(0.1, 0.7, -0.2),
        translation_m: Vector3::new(900.0, -3.0, -4000.0),
        scale: 1.0,
    };
    backend.set_keyframes(0, &[map_from_keyframe]);
    let moved = render(&mut backend, &still);
    assert_eq!(moved.stats.visible, 0, "the anchors follow their keyframe at once");
    let map_from_camera =
        Rigid::from_parts(Translation3::from(map_from_keyframe.translation_m), map_from_keyframe.rotation);
    let after = render(&mut backend, &View { camera_from_map: map_from_camera.inverse(), ..still });
    // The sky is fixed to the map and grey, so that only the Gaussians can differ.
    let worst = before.rgb.as_flattened().iter().zip(after.rgb.as_flattened()).map(|(a, b)| (a - b).abs());
    assert!(worst.fold(0.0, f32::max) < 1e-4);
}

#[test]
fn a_scaled_keyframe_looks_the_same_from_the_scaled_distance() {
    let still = view(48, 36);
    let (headers, params) = anchors(12, 6);
    let mut backend = backend(&still, &headers, &params, 1);
    let before = render(&mut backend, &still);
    backend.set_keyframes(0, &[KeyframePlacement { scale: 2.5, ..KeyframePlacement::identity() }]);
    let after = render(&mut backend, &still);
    for (a, b) in before.rgb.as_flattened().iter().zip(after.rgb.as_flattened()) {
        assert!((a - b).abs() < 1e-4);
    }
    for (a, b) in before.depth_m.iter().zip(&after.depth_m) {
        assert!((2.5 * a - b).abs() < 1e-3 * (1.0 + b));
    }
}

#[test]
fn the_middle_of_an_empty_map_shows_the_texel_it_looks_at() {
    let mut straight = view(32, 24);
    (straight.camera.cx, straight.camera.cy) = (16.5, 12.5);
    (straight.camera.fx, straight.camera.fy) = (3000.0, 3000.0);
    let (headers, params) = anchors(1, 1);
    let mut backend = backend(&straight, &headers, &params, 1);
    backend.retire_anchors(&[0]);
    let texels: Vec<[f32; 3]> =
        (0..BACKGROUND_TEXELS).map(|i| [i as f32 / BACKGROUND_TEXELS as f32, (i % 2) as f32, 0.25]).collect();
    assert!(backend.write_background(0, &texels));
    for (column, row) in [(0, 0), (5, 3), (64, 16), (127, 31), (100, 9)] {
        let ahead = background_texel_direction(column, row).cast::<f64>();
        let rotation = UnitQuaternion::rotation_between(&ahead, &Vector3::z())
            .unwrap_or(UnitQuaternion::from_axis_angle(&Vector3::y_axis(), core::f64::consts::PI));
        let looking = View { camera_from_map: Rigid::from_parts(Translation3::identity(), rotation), ..straight };
        let picture = render(&mut backend, &looking);
        let got = picture.rgb[12 * 32 + 16];
        let expected = texels[row * BACKGROUND_COLUMNS + column];
        let error = (0..3).map(|i| (got[i] - expected[i]).abs()).fold(0.0, f32::max);
        assert!(error < 0.02, "texel ({column}, {row}): {got:?}, expected {expected:?}");
        assert_eq!((picture.depth_m[0], picture.transmittance[0]), (0.0, 1.0));
    }
}

#[test]
fn nothing_is_allocated_after_construction() {
    let view = view(64, 48);
    let (headers, params) = anchors(20, 2);
    let mut backend = backend(&view, &headers, &params, 2);
    let gray = vec![90; view.n_pixels()];
    let (mut rgb, mut depth_m, mut transmittance) =
        (vec![[0.0; 3]; view.n_pixels()], vec![0.0; view.n_pixels()], vec![0.0; view.n_pixels()]);
    let sealed = seal::enter();
    for i in 0..5 {
        backend.train_step(&gray_view(view, &gray), &StepSettings::direct(0.1 * i as f32));
        backend.render(&view, RenderTarget { rgb: &mut rgb, depth_m: &mut depth_m, transmittance: &mut transmittance });
        backend.write_anchors(&[3], &headers[..1], &params[..K]);
        backend.retire_anchors(&[4]);
    }
    assert_eq!(sealed.violations(), (0, 0));
}

#[test]
fn a_level_that_is_missing_is_named_with_the_best_one() {
    let capacities = Capacities::for_map(1, 1, 16, 16);
    let Some(missing) = SimdLevel::ALL.into_iter().find(|level| !level.is_available()) else { return };
    match CpuBackend::new(capacities, 1, missing, |_| ()) {
        Err(error @ OpenError::Simd { .. }) => assert!(error.to_string().contains("--simd auto"), "{error}"),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("{missing} is not available"),
    }
}
