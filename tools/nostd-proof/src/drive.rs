//! A short drive through the whole tracker: corners, affine tracks, pose, bundle adjustment, scale from the road.

use kilogs_core::bundle::ReducedSystem;
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::correspondence::PixelMatch;
use kilogs_core::features::corners::Corner;
use kilogs_core::features::tracks::{Track, TrackStorage};
use kilogs_core::features::{Flow, SimdLevel};
use kilogs_core::frame::ImageView;
use kilogs_core::keyframe::Landmark;
use kilogs_core::math::Rng;
use kilogs_core::pose::{LandmarkMatch, Match};
use kilogs_core::tracking::{FrameStatus, KeyframePoint, Tracker, TrackerStorage, TrackingSettings};
use nalgebra::{Vector2, Vector3};

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
const STEP_M: f64 = 0.5;
const N_FRAMES: u64 = 10;
const FRAME_NS: u64 = 100_000_000;
/// How far the end may lie from the truth, relative to the way: it is metres that come out, not a shape.
const TOLERANCE: f64 = 0.06;

const N_TRACKS: usize = 512;
const N_LANDMARKS: usize = 2048;
/// Generous; too little is an error of `Tracker::new`.
const PYRAMID_BYTES: usize = 256 << 10;

const NO_Z1: Vector2<f64> = Vector2::new(0.0, 0.0);
const NO_PIXEL_MATCH: PixelMatch = PixelMatch { keyframe_px: [0.0; 2], current_px: [0.0; 2], confidence: 0.0 };
const NO_MATCH: Match = Match { first_z1: NO_Z1, second_z1: NO_Z1 };
const NO_LANDMARK_MATCH: LandmarkMatch =
    LandmarkMatch { reference_z1: NO_Z1, inverse_depth: 0.0, inverse_depth_sigma: 0.0, seen_z1: NO_Z1 };
const NO_POINT: KeyframePoint = KeyframePoint { pixel: [0.0; 2], depth_m: 0.0, relative_sigma: 0.0 };

/// All memory of the drive.
pub struct Storage {
    pixels: [u8; WIDTH * HEIGHT],
    pyramids: [[u8; PYRAMID_BYTES]; 3],
    tracks: [Track; N_TRACKS],
    at_keyframe: [Track; N_TRACKS],
    flows: [Flow; N_TRACKS],
    corners: [Corner; N_TRACKS],
    distances_px: [f32; N_TRACKS],
    landmarks: [Landmark; N_LANDMARKS],
    pixel_matches: [PixelMatch; N_TRACKS],
    matches: [Match; N_TRACKS],
    landmark_matches: [LandmarkMatch; N_TRACKS],
    is_inlier: [bool; N_TRACKS],
    landmark_of_track: [u32; N_TRACKS],
    landmark_of_match: [u32; N_TRACKS],
    keyframe_points: [KeyframePoint; N_TRACKS],
    bundle: ReducedSystem,
}

impl Storage {
    /// Nothing in it yet.
    pub const EMPTY: Self = Self {
        pixels: [0; WIDTH * HEIGHT],
        pyramids: [[0; PYRAMID_BYTES]; 3],
        tracks: [Track::NONE; N_TRACKS],
        at_keyframe: [Track::NONE; N_TRACKS],
        flows: [Flow::new([0.0; 2], [0.0; 2]); N_TRACKS],
        corners: [Corner::NONE; N_TRACKS],
        distances_px: [0.0; N_TRACKS],
        landmarks: [Landmark::NONE; N_LANDMARKS],
        pixel_matches: [NO_PIXEL_MATCH; N_TRACKS],
        matches: [NO_MATCH; N_TRACKS],
        landmark_matches: [NO_LANDMARK_MATCH; N_TRACKS],
        is_inlier: [false; N_TRACKS],
        landmark_of_track: [0; N_TRACKS],
        landmark_of_match: [0; N_TRACKS],
        keyframe_points: [NO_POINT; N_TRACKS],
        bundle: ReducedSystem::new(),
    };
}

/// Drives straight on and compares where the tracker ends with where it should.
pub fn along_a_street(storage: &mut Storage) -> Result<(), &'static str> {
    let [first, second, third] = &mut storage.pyramids;
    let tracker_storage = TrackerStorage {
        pyramids: [first, second, third],
        tracks: TrackStorage {
            tracks: &mut storage.tracks,
            at_keyframe: &mut storage.at_keyframe,
            flows: &mut storage.flows,
            corners: &mut storage.corners,
            distances_px: &mut storage.distances_px,
        },
        landmarks: &mut storage.landmarks,
        pixel_matches: &mut storage.pixel_matches,
        matches: &mut storage.matches,
        landmark_matches: &mut storage.landmark_matches,
        is_inlier: &mut storage.is_inlier,
        landmark_of_track: &mut storage.landmark_of_track,
        landmark_of_match: &mut storage.landmark_of_match,
        keyframe_points: &mut storage.keyframe_points,
        bundle: &mut storage.bundle,
    };
    let settings = TrackingSettings::STANDARD;
    let mut tracker = Tracker::new(CAMERA, MOUNTING, settings, SimdLevel::new(), 1, tracker_storage)
        .map_err(|_| "the tracker's storage is too small")?;
    let (mut n_tracked, mut n_keyframes, mut end_m) = (0, 0, Vector3::zeros());
    for frame in 0..N_FRAMES {
        street(frame as f64 * STEP_M, &mut storage.pixels);
        let image = ImageView::new(&storage.pixels, WIDTH, HEIGHT, WIDTH).map_err(|_| "the image is too short")?;
        let report = tracker.step(image, frame, (frame + 1) * FRAME_NS);
        n_tracked += u64::from(report.status == FrameStatus::Tracked);
        n_keyframes += u64::from(report.is_keyframe);
        end_m = report.world_from_camera.translation.vector;
    }
    if n_tracked < N_FRAMES - 1 || n_keyframes < 3 {
        return Err("the tracker lost a street that is easy to see");
    }
    let way_m = STEP_M * (N_FRAMES - 1) as f64;
    let is_right = (end_m - Vector3::z() * way_m).norm() < TOLERANCE * way_m;
    if is_right { Ok(()) } else { Err("the tracker ended in the wrong place") }
}

/// A street between two walls, seen from `z_m` along it.
fn street(z_m: f64, pixels: &mut [u8]) {
    const WALL_M: f64 = 5.0;
    const FARTHEST_M: f64 = 80.0;
    const GREY: f64 = 128.0;
    for (i, pixel) in pixels.iter_mut().enumerate() {
        let x = ((i % WIDTH) as f64 + 0.5 - CAMERA.cx) / CAMERA.fx;
        let y = ((i / WIDTH) as f64 + 0.5 - CAMERA.cy) / CAMERA.fy;
        let to_wall = WALL_M / x.abs().max(1e-3);
        let to_road = if y > 0.0 { MOUNTING.height_m / y } else { f64::INFINITY };
        let depth_m = to_wall.min(to_road);
        let grey = if depth_m > FARTHEST_M {
            GREY
        } else if to_road < to_wall {
            texture(1, x * depth_m, depth_m + z_m, 0.35)
        } else {
            texture(if x > 0.0 { 2 } else { 3 }, y * depth_m, depth_m + z_m, 0.7)
        };
        *pixel = grey as u8;
    }
}

/// Grey of a surface, smooth between random values on a grid of `cell_m`.
fn texture(seed: u64, a_m: f64, b_m: f64, cell_m: f64) -> f64 {
    // Far beyond every place in the street, so that the casts round down.
    const FAR: f64 = 1e6;
    let (a, b) = (a_m / cell_m + FAR, b_m / cell_m + FAR);
    let (i, j) = (a as u64, b as u64);
    let at = |di: u64, dj: u64| Rng::new(seed, i + di, j + dj).unit_f64() * 200.0 + 20.0;
    let (u, v) = (a - i as f64, b - j as f64);
    let mix = |p: f64, q: f64, w: f64| p + w * (q - p);
    mix(mix(at(0, 0), at(1, 0), u), mix(at(0, 1), at(1, 1), u), v)
}
