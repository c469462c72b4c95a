//! The tracking problems that the proof solves, each with the answer known beforehand.

use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::features::corners::Corner;
use kilogs_core::features::lk::track_there_and_back;
use kilogs_core::features::tracks::{Track, TrackImages, TrackSettings, TrackStorage, TrackTable};
use kilogs_core::features::{Flow, LkSettings, SimdLevel};
use kilogs_core::frame::{ImageView, Pyramid};
use kilogs_core::math::{Rng, se3};
use kilogs_core::pose::{Match, RelativeSettings, estimate_relative};
use nalgebra::{Matrix2x3, Matrix2x6, Matrix3x6, Matrix6, Point3, Vector2, Vector3, Vector6};

const CAMERA: Pinhole = Pinhole { width: 160, height: 120, fx: 120.0, fy: 120.0, cx: 80.0, cy: 60.0 };
const N_POINTS: usize = 64;

/// Solves every problem; the error names the one whose answer was wrong.
pub fn solve_all() -> Result<(), &'static str> {
    pose_from_points()?;
    motion_from_matches()?;
    points_through_images()?;
    tracks_through_images()
}

/// Points ahead of the camera, the same in every run.
fn points_in_world() -> [Vector3<f64>; N_POINTS] {
    let mut rng = Rng::new(1, 2, 3);
    core::array::from_fn(|_| {
        let mut side = |half_width_m: f64| (2.0 * rng.unit_f64() - 1.0) * half_width_m;
        Vector3::new(side(4.0), side(2.0), 9.0 + side(4.0))
    })
}

/// Finds a camera from where it sees known points, by Gauss-Newton from the identity.
fn pose_from_points() -> Result<(), &'static str> {
    let true_camera_from_world = se3::exp(&Vector6::new(0.02, -0.05, 0.01, 0.2, -0.1, -0.6));
    let points_in_world = points_in_world();
    let mut camera_from_world = Rigid::identity();
    for _ in 0..10 {
        let mut information = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for point_in_world in &points_in_world {
            let Some(seen) = CAMERA.project(&(true_camera_from_world * Point3::from(*point_in_world)).coords) else {
                return Err("a point lies behind the true camera");
            };
            let point_in_camera = (camera_from_world * Point3::from(*point_in_world)).coords;
            let Some((predicted, jacobian)) = projection_with_jacobian(&point_in_camera) else {
                return Err("a point lies behind the estimated camera");
            };
            information += jacobian.transpose() * jacobian;
            gradient += jacobian.transpose() * (predicted - seen);
        }
        let Some(factor) = information.cholesky() else { return Err("the normal equations are singular") };
        camera_from_world = se3::exp(&-factor.solve(&gradient)) * camera_from_world;
    }
    let error = se3::log(&(camera_from_world * true_camera_from_world.inverse())).norm();
    if error < 1e-9 { Ok(()) } else { Err("the pose from points is wrong") }
}

/// Pixel of a point, and its derivative by a left increment of `camera_from_world`.
fn projection_with_jacobian(point_in_camera: &Vector3<f64>) -> Option<(Vector2<f64>, Matrix2x6<f64>)> {
    let pixel = CAMERA.project(point_in_camera)?;
    let (x, y, z) = (point_in_camera.x, point_in_camera.y, point_in_camera.z);
    let by_point =
        Matrix2x3::new(CAMERA.fx / z, 0.0, -CAMERA.fx * x / (z * z), 0.0, CAMERA.fy / z, -CAMERA.fy * y / (z * z));
    let mut by_tangent = Matrix3x6::zeros();
    by_tangent.fixed_columns_mut::<3>(0).copy_from(&-se3::skew(point_in_camera));
    by_tangent.fixed_columns_mut::<3>(3).fill_with_identity();
    Some((pixel, by_point * by_tangent))
}

/// Finds the motion between two views from matches of which every fifth is wrong.
fn motion_from_matches() -> Result<(), &'static str> {
    let second_from_first = se3::exp(&Vector6::new(0.01, 0.06, -0.01, 0.1, 0.0, -0.9));
    let mut matches = [Match::default(); N_POINTS];
    for (i, (slot, point_in_first)) in matches.iter_mut().zip(points_in_world()).enumerate() {
        let point_in_second = (second_from_first * Point3::from(point_in_first)).coords;
        let wrong = if i % 5 == 0 { 0.1 } else { 0.0 };
        let second_z1 = point_in_second.xy() / point_in_second.z + Vector2::new(0.0, wrong);
        *slot = Match { first_z1: point_in_first.xy() / point_in_first.z, second_z1 };
    }
    let settings = RelativeSettings { inlier_z1: 1e-3, confidence: 0.999, trials: [10, 500], local_iterations: 10 };
    let mut is_inlier = [false; N_POINTS];
    let mut rng = Rng::new(4, 5, 6);
    let Ok(found) = estimate_relative(&matches, None, &settings, &mut rng, &mut is_inlier) else {
        return Err("no motion was found from the matches");
    };
    let rotation_error_rad = found.second_from_first.rotation.angle_to(&second_from_first.rotation);
    let direction = second_from_first.translation.vector.normalize();
    let is_right = rotation_error_rad < 1e-6 && found.second_from_first.direction.dot(&direction) > 1.0 - 1e-9;
    if is_right { Ok(()) } else { Err("the motion from matches is wrong") }
}

const WIDTH: usize = 160;
const HEIGHT: usize = 120;
const N_LEVELS: usize = 3;

/// Generous; the exact number is `kilogs_core::frame::pyramid::bytes_needed`, and too little is an error.
const PYRAMID_BYTES: usize = 64 << 10;

/// Follows points through two images of a texture that moved by a known amount.
fn points_through_images() -> Result<(), &'static str> {
    const MOTION_PX: [f32; 2] = [5.3, -3.7];
    let (mut source_storage, mut target_storage) = ([0; PYRAMID_BYTES], [0; PYRAMID_BYTES]);
    let source = pyramid_of_texture([0.0, 0.0], &mut source_storage)?;
    let target = pyramid_of_texture(MOTION_PX, &mut target_storage)?;
    let mut flows = [Flow::new([0.0; 2], [0.0; 2]); 20];
    for (i, flow) in flows.iter_mut().enumerate() {
        let point_px = [30.0 + 20.0 * (i % 5) as f32, 30.0 + 20.0 * (i / 5) as f32];
        *flow = Flow::new(point_px, point_px);
    }
    let settings = LkSettings { n_levels: N_LEVELS as u32, ..LkSettings::STANDARD };
    track_there_and_back(SimdLevel::Scalar, &source, &target, &settings, &mut flows);
    let is_right = |flow: &Flow| {
        let error_px = |axis: usize| (flow.target_px[axis] - flow.source_px[axis] - MOTION_PX[axis]).abs();
        flow.verdict.is_found() && error_px(0) < 0.1 && error_px(1) < 0.1
    };
    if flows.iter().all(is_right) { Ok(()) } else { Err("a point was lost or went astray") }
}

/// Finds corners by itself, follows them and refines them against the keyframe's windows.
fn tracks_through_images() -> Result<(), &'static str> {
    const MOTION_PX: [f32; 2] = [2.6, -1.4];
    const N_TRACKS: usize = 64;
    let (mut first_storage, mut second_storage) = ([0; PYRAMID_BYTES], [0; PYRAMID_BYTES]);
    let first = pyramid_of_texture([0.0, 0.0], &mut first_storage)?;
    let second = pyramid_of_texture(MOTION_PX, &mut second_storage)?;
    let storage = TrackStorage {
        tracks: &mut [Track::NONE; N_TRACKS],
        at_keyframe: &mut [Track::NONE; N_TRACKS],
        flows: &mut [Flow::new([0.0; 2], [0.0; 2]); N_TRACKS],
        corners: &mut [Corner::NONE; N_TRACKS],
        distances_px: &mut [0.0; N_TRACKS],
    };
    let mut tracks = TrackTable::new(storage).map_err(|_| "the storage of the tracks is uneven")?;
    let mut settings = TrackSettings::STANDARD;
    settings.lk.n_levels = N_LEVELS as u32;
    let n_found = tracks.promote(SimdLevel::Scalar, &first, &settings).n_found;
    let images = TrackImages { keyframe: &first, previous: &first, current: &second };
    let n_live = tracks.advance(SimdLevel::Scalar, images, &settings).n_live;
    if n_found < N_TRACKS / 2 || n_live < n_found / 2 {
        return Err("too few corners were found or followed");
    }
    let is_right = |track: &Track| {
        let error_px = |axis: usize| (track.current_px[axis] - track.keyframe_px[axis] - MOTION_PX[axis]).abs();
        error_px(0) < 0.1 && error_px(1) < 0.1
    };
    let n_right = tracks.tracks().iter().filter(|track| is_right(track)).count();
    if n_right * 10 >= n_live * 9 { Ok(()) } else { Err("the tracks went astray") }
}

/// Parabolic bumps of several sizes, moved by `motion_px`.
fn pyramid_of_texture<'m>(motion_px: [f32; 2], storage: &'m mut [u8]) -> Result<Pyramid<'m>, &'static str> {
    let mut pixels = [0_u8; WIDTH * HEIGHT];
    for (i, pixel) in pixels.iter_mut().enumerate() {
        let (x, y) = ((i % WIDTH) as f32 + 0.5 - motion_px[0], (i / WIDTH) as f32 + 0.5 - motion_px[1]);
        let texture = wave(x / 37.0 + y / 61.0) + wave(x / 23.0 - y / 31.0) + wave(y / 19.0 + x / 97.0);
        *pixel = (128.0 + 40.0 * texture) as u8;
    }
    let mut pyramid =
        Pyramid::new(storage, WIDTH, HEIGHT, N_LEVELS).map_err(|_| "the storage of a pyramid is too small")?;
    let view = ImageView::new(&pixels, WIDTH, HEIGHT, WIDTH).map_err(|_| "the image does not cover its pixels")?;
    pyramid.build(view).map_err(|_| "the image has another size than the pyramid")?;
    Ok(pyramid)
}

/// Period 1, range [-1, 1], smooth: two parabolas.
fn wave(x: f32) -> f32 {
    // Far above any argument's size, so that the cast rounds down.
    let phase = x - ((x + 1000.0) as i32 - 1000) as f32;
    if phase < 0.5 { 16.0 * phase * (0.5 - phase) } else { -16.0 * (phase - 0.5) * (1.0 - phase) }
}
