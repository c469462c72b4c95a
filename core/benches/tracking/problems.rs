//! Problems whose solution is known, drawn as `peers.py`'s model has them: a street camera that drives 1 m ahead.

use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::keyframe::{KeyframeWindow, Landmark, WINDOW};
use kilogs_core::math::{Rng, se3};
use kilogs_core::pose::{LandmarkMatch, Match};
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector2, Vector3, Vector6};

/// KITTI's grey camera of sequence 00.
pub const CAMERA: Pinhole = Pinhole { width: 1241, height: 376, fx: 718.856, fy: 718.856, cx: 607.19, cy: 185.22 };
/// Standard deviation of a pixel in either image.
pub const NOISE_PX: f64 = 0.5;
const DEPTH_M: [f64; 2] = [5.0, 50.0];
const BORDER_PX: f64 = 20.0;
/// Points of a [`Scene::Plane`] have 1 as their product with this: 12 m ahead.
const PLANE_PER_M: Vector3<f64> = Vector3::new(0.04, 0.03, 1.0 / 12.0);

/// Where the points lie.
#[derive(Clone, Copy, PartialEq)]
pub enum Scene {
    /// At all depths.
    Space,
    /// On one slanted plane.
    Plane,
}

/// Points in two images, some of them outliers.
pub struct TwoViews {
    /// Pixel in the first image, pixel in the second, and the point in the first camera, m.
    pub points: Vec<([f64; 2], [f64; 2], [f64; 3])>,
}

/// The motion behind every [`TwoViews`].
pub fn second_from_first() -> Rigid {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.01, 0.03, -0.005));
    let center_in_first = Vector3::new(0.05, 0.02, 1.0);
    Rigid::from_parts(Translation3::from(-(rotation * center_in_first)), rotation)
}

/// Gaussian number (Box & Muller 1958).
pub fn normal(rng: &mut Rng) -> f64 {
    let radius = (-2.0 * (1.0 - rng.unit_f64()).ln()).sqrt();
    radius * (std::f64::consts::TAU * rng.unit_f64()).cos()
}

impl TwoViews {
    /// `n` points of which a share are outliers, uniform over the second image.
    pub fn new(scene: Scene, n: usize, outlier_ratio: f64, seed: u64) -> Self {
        let mut rng = Rng::new(seed, n as u64, (outlier_ratio * 100.0) as u64);
        let n_outliers = (outlier_ratio * n as f64) as usize;
        let (width, height) = (f64::from(CAMERA.width), f64::from(CAMERA.height));
        let points = (0..n).map(|i| {
            let within = |low: f64, high: f64, rng: &mut Rng| low + (high - low) * rng.unit_f64();
            let pixel = Vector2::new(
                within(BORDER_PX, width - BORDER_PX, &mut rng),
                within(BORDER_PX, height - BORDER_PX, &mut rng),
            );
            let z1 = CAMERA.unproject_z1(&pixel);
            let depth_m = within(DEPTH_M[0], DEPTH_M[1], &mut rng);
            let ray = Vector3::new(z1.x, z1.y, 1.0);
            let point = if scene == Scene::Plane { ray / PLANE_PER_M.dot(&ray) } else { ray * depth_m };
            let seen = CAMERA.project(&(second_from_first() * Point3::from(point)).coords).unwrap_or_default();
            let mut noisy = |p: Vector2<f64>| [p.x + NOISE_PX * normal(&mut rng), p.y + NOISE_PX * normal(&mut rng)];
            let (first, mut second) = (noisy(pixel), noisy(seen));
            if i < n_outliers {
                second = [within(0.0, width, &mut rng), within(0.0, height, &mut rng)];
            }
            (first, second, point.into())
        });
        Self { points: points.collect() }
    }

    /// For the relative pose.
    pub fn matches(&self) -> Vec<Match> {
        let z1 = |pixel: &[f64; 2]| CAMERA.unproject_z1(&Vector2::from(*pixel));
        self.points.iter().map(|(first, second, _)| Match { first_z1: z1(first), second_z1: z1(second) }).collect()
    }

    /// For the absolute pose: exact points, noisy sightings.
    pub fn landmark_matches(&self) -> Vec<LandmarkMatch> {
        let exact = |&(_, second, [x, y, z]): &([f64; 2], [f64; 2], [f64; 3])| LandmarkMatch {
            reference_z1: Vector2::new(x / z, y / z),
            inverse_depth: 1.0 / z,
            inverse_depth_sigma: 0.0,
            seen_z1: CAMERA.unproject_z1(&Vector2::from(second)),
        };
        self.points.iter().map(exact).collect()
    }

    /// Eight bytes per number, little endian: seven numbers per point.
    pub fn bytes(&self) -> Vec<u8> {
        let numbers = self.points.iter().flat_map(|(a, b, p)| a.iter().chain(b).chain(p));
        numbers.flat_map(|number| number.to_le_bytes()).collect()
    }
}

/// A full window with `n` landmarks, each seen by all keyframes: poses and depths are off, sightings noisy.
pub fn window(n: usize, seed: u64) -> (KeyframeWindow, Vec<Landmark>) {
    let mut rng = Rng::new(seed, n as u64, 1);
    let mut window = KeyframeWindow::new();
    let mut landmarks = vec![Landmark::default(); n];
    for i in 0..WINDOW {
        let off = if i < 2 { Vector6::zeros() } else { Vector6::new(0.002, -0.003, 0.001, 0.05, 0.03, 0.1) };
        window.push(i as u64, 0, se3::exp(&off) * camera_of_window(i), &mut landmarks);
    }
    let noise_z1 = NOISE_PX / CAMERA.fx;
    for landmark in &mut landmarks {
        let z = 12.0 + 30.0 * rng.unit_f64();
        let point = Point3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.4 * z, z);
        for i in 0..WINDOW {
            let seen = camera_of_window(i) * point;
            let noise = Vector2::new(normal(&mut rng), normal(&mut rng)) * noise_z1;
            landmark.record(i, &(seen.coords.xy() / seen.z + noise));
        }
        (landmark.inverse_depth, landmark.sigma) = (1.2 / z, 0.1 / z);
    }
    (window, landmarks)
}

/// True pose of a keyframe of [`window`].
pub fn camera_of_window(i: usize) -> Rigid {
    let i = i as f64;
    se3::exp(&Vector6::new(0.002 * i, -0.03 * i, 0.0, 0.05 * i, 0.0, -i))
}
