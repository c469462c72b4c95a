//! The tracker on a painted street: what it finds, and what it does when there is nothing to find.

use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::conventions::TimestampNs;
use kilogs_core::frame::ImageView;
use kilogs_core::math::Rng;
use kilogs_core::tracking::{FrameReport, FrameStatus, StatusReason, Tracker};
use nalgebra::Vector3;

const WIDTH: usize = 480;
const HEIGHT: usize = 200;
const CAMERA: Pinhole = Pinhole { width: 480, height: 200, fx: 280.0, fy: 280.0, cx: 240.0, cy: 80.0 };
const MOUNTING: Mounting = Mounting {
    height_m: 1.5,
    pitch_rad: 0.0,
    roll_rad: 0.0,
    forward_axis: [0.0, 0.0, 1.0],
    lever_arm_m: [0.0, 0.0, -1.5],
};
const FRAME_NS: TimestampNs = 100_000_000;

/// Grey of a surface, smooth between random values on a grid of `cell_m`.
fn texture(seed: u64, a: f64, b: f64, cell_m: f64) -> f64 {
    let (a, b) = (a / cell_m, b / cell_m);
    let (i, j) = (a.floor(), b.floor());
    let at = |di: f64, dj: f64| Rng::new(seed, (i + di + 1e6) as u64, (j + dj + 1e6) as u64).unit_f64() * 200.0 + 20.0;
    let (u, v) = (a - i, b - j);
    let mix = |p: f64, q: f64, w: f64| p + w * (q - p);
    mix(mix(at(0.0, 0.0), at(1.0, 0.0), u), mix(at(0.0, 1.0), at(1.0, 1.0), u), v)
}

/// A street between two walls, seen from `z_m` along it.
fn street(z_m: f64) -> Vec<u8> {
    const WALL_M: f64 = 5.0;
    let mut pixels = Vec::with_capacity(WIDTH * HEIGHT);
    for row in 0..HEIGHT {
        for column in 0..WIDTH {
            let x = (column as f64 + 0.5 - CAMERA.cx) / CAMERA.fx;
            let y = (row as f64 + 0.5 - CAMERA.cy) / CAMERA.fy;
            let to_wall = WALL_M / x.abs().max(1e-3);
            let to_road = if y > 0.0 { MOUNTING.height_m / y } else { f64::INFINITY };
            let depth = to_wall.min(to_road);
            let grey = if depth > 80.0 {
                128.0
            } else if to_road < to_wall {
                texture(1, x * depth, depth + z_m, 0.35)
            } else {
                texture(if x > 0.0 { 2 } else { 3 }, y * depth, depth + z_m, 0.7)
            };
            pixels.push(grey as u8);
        }
    }
    pixels
}

fn with_tracker<R>(drive: impl FnOnce(&mut Tracker<'_>) -> R) -> R {
    kilogs_tests::tracker::with_tracker(CAMERA, MOUNTING, 1, drive)
}

fn step(tracker: &mut Tracker<'_>, pixels: &[u8], frame: u64) -> FrameReport {
    let image = ImageView::new(pixels, WIDTH, HEIGHT, WIDTH).expect("size");
    let report = tracker.step(image, frame, (frame + 1) * FRAME_NS);
    assert!(report.world_from_camera.to_homogeneous().iter().all(|v| v.is_finite()), "{report:?}");
    assert!(report.covariance.iter().all(|v| v.is_finite()), "{report:?}");
    assert_eq!(report.covariance, report.covariance.transpose());
    assert!(report.covariance.cholesky().is_some(), "positive definite: {report:?}");
    report
}

/// Standard deviation of the position, m.
fn position_sigma_m(report: &FrameReport) -> f64 {
    (3..6).map(|k| report.covariance[(k, k)]).sum::<f64>().sqrt()
}

#[test]
fn a_drive_along_a_street_comes_out_in_metres() {
    const STEP_M: f64 = 0.5;
    const N_FRAMES: u64 = 16;
    with_tracker(|tracker| {
        let reports: Vec<_> = (0..N_FRAMES).map(|i| step(tracker, &street(i as f64 * STEP_M), i)).collect();
        let n_tracked = reports.iter().filter(|r| r.status == FrameStatus::Tracked).count();
        assert!(n_tracked >= N_FRAMES as usize - 1, "{reports:?}");
        let end = reports.last().expect("frames").world_from_camera.translation.vector;
        let truth = Vector3::z() * (STEP_M * (N_FRAMES - 1) as f64);
        assert!((end - truth).norm() < 0.05 * truth.norm(), "{end}");
        assert!(tracker.keyframe_points().len() > 30, "{}", tracker.keyframe_points().len());
        assert_eq!(tracker.road_plane().map(|road| road.height_m), Some(MOUNTING.height_m));
        let sigmas_m: Vec<f64> = reports.iter().map(position_sigma_m).collect();
        assert!(sigmas_m[0] < 1e-5, "the first frame defines the world: {sigmas_m:?}");
        // The way of the first half cannot be corrected any more, so its error stays.
        assert!(sigmas_m[15] > sigmas_m[8] && sigmas_m[8] > sigmas_m[4], "{sigmas_m:?}");
        let off = (end - truth).norm() / sigmas_m[15];
        assert!(off < 3.0, "{off} standard deviations off, {sigmas_m:?}");
    });
}

#[test]
fn a_standing_vehicle_stays_where_it_is_and_is_tracked() {
    let pixels = street(0.0);
    with_tracker(|tracker| {
        for i in 0..5 {
            let report = step(tracker, &pixels, i);
            assert_eq!(report.status, FrameStatus::Tracked);
            assert!(report.world_from_camera.translation.vector.norm() < 1e-9);
            assert_eq!(report.is_keyframe, i == 0);
        }
    });
}

#[test]
fn a_camera_that_hangs_is_told_from_a_vehicle_that_stands() {
    const STEP_M: f64 = 0.5;
    with_tracker(|tracker| {
        for i in 0..10 {
            assert_eq!(step(tracker, &street(i as f64 * STEP_M), i).status, FrameStatus::Tracked);
        }
        let hung_at = street(9.0 * STEP_M);
        for i in 10..18 {
            let report = step(tracker, &hung_at, i);
            assert_eq!((report.status, report.reason), (FrameStatus::Doubtful, StatusReason::Frozen));
            let expected_m = STEP_M * i as f64;
            assert!((report.world_from_camera.translation.z - expected_m).abs() < 0.05 * expected_m, "{report:?}");
        }
        // Half a metre after the image that hung, and a second later: it was the vehicle that had stopped.
        let after = step(tracker, &street(10.0 * STEP_M), 18);
        assert_eq!(after.status, FrameStatus::Tracked);
        assert!((after.world_from_camera.translation.z - 10.0 * STEP_M).abs() < 0.3, "{after:?}");
    });
}

#[test]
fn black_images_are_lost_and_tracking_starts_anew_behind_them() {
    let black = vec![0; WIDTH * HEIGHT];
    with_tracker(|tracker| {
        assert_eq!(step(tracker, &black, 0).status, FrameStatus::Lost);
        let first = step(tracker, &street(0.0), 1);
        assert_eq!((first.status, first.reason), (FrameStatus::Tracked, StatusReason::FirstFrame));
        let lost = step(tracker, &black, 2);
        assert_eq!(lost.status, FrameStatus::Lost);
        assert!(position_sigma_m(&lost) > 0.04, "0.1 s at some unknown speed: {}", position_sigma_m(&lost));
        let restarted = step(tracker, &street(0.0), 3);
        assert_eq!(restarted.reason, StatusReason::Restarted);
        let tracked = step(tracker, &street(0.0), 4);
        assert_eq!(tracked.status, FrameStatus::Tracked);
        // What happened in the dark is never found out.
        let sigmas_m = [&first, &lost, &restarted, &tracked].map(position_sigma_m);
        assert!(sigmas_m.is_sorted(), "{sigmas_m:?}");
    });
}

#[test]
fn an_image_of_another_size_or_time_is_unusable_and_changes_nothing() {
    let pixels = street(0.0);
    with_tracker(|tracker| {
        step(tracker, &pixels, 0);
        let small = ImageView::new(&pixels, WIDTH / 2, HEIGHT, WIDTH).expect("size");
        assert_eq!(tracker.step(small, 1, 2 * FRAME_NS).reason, StatusReason::Unusable);
        let image = ImageView::new(&pixels, WIDTH, HEIGHT, WIDTH).expect("size");
        assert_eq!(tracker.step(image, 1, FRAME_NS).reason, StatusReason::Unusable);
        assert_eq!(step(tracker, &pixels, 2).status, FrameStatus::Tracked);
    });
}
