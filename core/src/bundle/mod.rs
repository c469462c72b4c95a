//! Windowed bundle adjustment: keyframe poses and inverse depths together.

mod equations;
mod reduced;

pub use reduced::ReducedSystem;

use crate::conventions::Rigid;
use crate::keyframe::{Column, KeyframeWindow, Landmark, SHORTEST_BASELINE_M, WINDOW};
use crate::math::se3;
use crate::pose::Stop;
use equations::{Graph, finish, linearize, move_depths, restore_depths, total_cost};
use nalgebra::{Matrix6, Vector6};

/// How the adjustment iterates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BundleSettings {
    /// Standard deviation of a sighting on the plane z = 1, per axis (pixels over focal length).
    pub noise_z1: f64,
    /// Width of Huber's kernel in standard deviations. Range 1..5; 1.345 is 95 % efficient on Gaussian noise.
    pub huber_sigmas: f64,
    /// A landmark whose root mean square error stays above this many standard deviations is an outlier. Range 2..10.
    pub outlier_sigmas: f64,
    /// Levenberg-Marquardt steps. Range 1..50.
    pub max_iterations: usize,
    /// Keyframes that have to see a landmark for it to say anything about poses. Range 2..8; the depths of the others
    /// follow.
    pub min_sightings: u32,
}

/// What is known about the newest keyframe's pose beside its sightings.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosePrior {
    /// Where it is expected.
    pub camera_from_world: Rigid,
    /// Information of the left increment against that (rad, m).
    pub information: Matrix6<f64>,
}

impl PosePrior {
    fn off(&self, graph: &Graph, column: Column) -> Vector6<f64> {
        let pose = graph.pose(column).unwrap_or(self.camera_from_world);
        se3::log(&(pose * self.camera_from_world.inverse()))
    }

    fn cost(&self, graph: &Graph, column: Column) -> f64 {
        let off = self.off(graph, column);
        off.dot(&(self.information * off))
    }

    fn add_to(&self, graph: &Graph, column: Column, system: &mut ReducedSystem) {
        if let Some(place) = graph.place(column) {
            system.add_block(place, place, &self.information);
            system.add_gradient(place, &(self.information * self.off(graph, column)));
        }
    }
}

/// What the adjustment did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BundleReport {
    /// Robust cost before, in squared standard deviations.
    pub first_cost: f64,
    /// Robust cost after.
    pub last_cost: f64,
    /// Accepted steps.
    pub n_steps: usize,
    /// Landmarks newly found to be outliers.
    pub n_outliers: usize,
    /// Why it stopped.
    pub stop: Stop,
}

const FIRST_DAMPING: f64 = 1e-4;
const DAMPING_FACTOR: f64 = 10.0;
const MAX_DAMPING: f64 = 1e6;
/// A relative gain below this ends the iteration.
const NEGLIGIBLE_GAIN: f64 = 1e-4;

/// How many of the oldest keyframes hold the window's place and scale: up to the first that stands elsewhere than the oldest,
/// since keyframes of a turn on the spot hold no scale.
fn n_fixed(window: &KeyframeWindow) -> usize {
    let centers =
        || window.columns_by_age().filter_map(|c| window.at(c)).map(|k| k.camera_from_world.inverse().translation);
    let Some(oldest) = centers().next() else { return 0 };
    let stays = centers().take_while(|c| (c.vector - oldest.vector).norm() < SHORTEST_BASELINE_M);
    stays.count() + 1
}

/// Adjusts the keyframes of the window (but for the oldest two, or more after a turn on the spot) and the landmarks' inverse depths.
///
/// Minimises  sum_ij rho(|| z_ij - pi(T_j T_h^-1 (x_i, 1 / depth_i)) ||^2 / sigma^2)  with rho = Huber, the depths
/// eliminated by the Schur complement.
///
/// # Inputs
/// * `window`, `landmarks`: improved in place; landmarks without depth or marked as outliers are left alone.
/// * `prior`: of the newest keyframe, where its sightings are few.
/// * `system`: work space.
///
/// # Output
/// Costs and counts. Nothing happens with fewer than three keyframes, or before one stands elsewhere than the oldest.
///
/// # Cost
/// O(sightings * iterations + (6 keyframes)^3); 14 KiB of stack.
///
/// # Source
/// Triggs, McLauchlan, Hartley & Fitzgibbon 1999, sec. 6; Civera et al. 2008 (inverse depth). Own implementation.
pub fn adjust(
    window: &mut KeyframeWindow,
    landmarks: &mut [Landmark],
    prior: Option<&PosePrior>,
    system: &mut ReducedSystem,
    settings: &BundleSettings,
) -> BundleReport {
    let mut report = BundleReport { first_cost: 0.0, last_cost: 0.0, n_steps: 0, n_outliers: 0, stop: Stop::StepLimit };
    let n_fixed = n_fixed(window);
    if window.len() <= n_fixed {
        report.stop = Stop::Stalled;
        return report;
    }
    let mut graph = Graph::new(window, n_fixed);
    let prior = prior.zip(window.columns_by_age().last());
    let cost_of = |graph: &Graph, landmarks: &[Landmark]| {
        total_cost(graph, landmarks, settings) + prior.map_or(0.0, |(prior, column)| prior.cost(graph, column))
    };
    let mut damping = FIRST_DAMPING;
    let mut cost = cost_of(&graph, landmarks);
    report.first_cost = cost;
    for _ in 0..settings.max_iterations {
        linearize(&graph, landmarks, settings, damping, system);
        if let Some((prior, column)) = prior {
            prior.add_to(&graph, column, system);
        }
        let Some(step) = system.solve(graph.n_free(), damping) else {
            report.stop = Stop::Stalled;
            break;
        };
        let mut candidate = graph.clone();
        candidate.apply(&step);
        move_depths(&graph, &step, landmarks, settings, damping);
        let candidate_cost = cost_of(&candidate, landmarks);
        if candidate_cost < cost {
            let gain = (cost - candidate_cost) / cost;
            (graph, cost) = (candidate, candidate_cost);
            damping = (damping / DAMPING_FACTOR).max(f64::EPSILON);
            report.n_steps += 1;
            if gain < NEGLIGIBLE_GAIN {
                report.stop = Stop::Converged;
                break;
            }
        } else {
            restore_depths(landmarks);
            damping *= DAMPING_FACTOR;
            if damping > MAX_DAMPING {
                report.stop = Stop::Converged;
                break;
            }
        }
    }
    report.last_cost = cost;
    for column in 0..WINDOW {
        if let (Some(keyframe), Some(pose)) = (window.at_mut(column), graph.pose(column)) {
            keyframe.camera_from_world = pose;
        }
    }
    report.n_outliers = finish(&graph, landmarks, settings);
    report
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::{Point3, Vector2, Vector3};
    use std::{boxed::Box, vec::Vec};

    const SETTINGS: BundleSettings = BundleSettings {
        noise_z1: 5e-4,
        huber_sigmas: 1.345,
        outlier_sigmas: 5.0,
        max_iterations: 20,
        min_sightings: 2,
    };

    fn truth(i: usize) -> Rigid {
        let i = i as f64;
        se3::exp(&Vector6::new(0.002 * i, -0.03 * i, 0.0, 0.05 * i, 0.0, -i))
    }

    /// A window of true poses, disturbed from the third on, with landmarks whose depths are 20 % off.
    fn scene(n_keyframes: usize, noise_z1: f64) -> (KeyframeWindow, Vec<Landmark>) {
        let mut rng = Rng::new(21, 0, 0);
        let mut window = KeyframeWindow::new();
        let mut landmarks = std::vec![Landmark::default(); 150];
        for i in 0..n_keyframes {
            let off = if i < 2 { Vector6::zeros() } else { Vector6::new(0.002, -0.003, 0.001, 0.05, 0.03, 0.1) };
            window.push(i as u64, 0, se3::exp(&off) * truth(i), &mut landmarks);
        }
        for landmark in &mut landmarks {
            let z = 12.0 + 30.0 * rng.unit_f64();
            let p = Point3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.4 * z, z);
            for i in 0..n_keyframes {
                let q = truth(i) * p;
                let noise = Vector2::new(rng.unit_f64() - 0.5, rng.unit_f64() - 0.5) * noise_z1;
                landmark.record(i, &(q.coords.xy() / q.z + noise));
            }
            landmark.inverse_depth = 1.2 / z;
            landmark.sigma = 0.1 / z;
        }
        (window, landmarks)
    }

    fn worst_pose_error(window: &KeyframeWindow, n_keyframes: usize) -> f64 {
        let error = |i| se3::log(&(window.at(i).expect("filled").camera_from_world * truth(i).inverse())).norm();
        (0..n_keyframes).map(error).fold(0.0, f64::max)
    }

    fn check(n_keyframes: usize, noise_z1: f64, at_most: f64) {
        let (mut window, mut landmarks) = scene(n_keyframes, noise_z1);
        let mut system = Box::new(ReducedSystem::new());
        let report = adjust(&mut window, &mut landmarks, None, &mut system, &SETTINGS);
        let error = worst_pose_error(&window, n_keyframes);
        assert!(error < at_most, "{error} {report:?}");
        assert!(report.last_cost < report.first_cost);
    }

    #[test]
    fn disturbed_poses_and_depths_return_to_the_truth() {
        check(3, 0.0, 1e-4);
        check(WINDOW, 0.0, 1e-4);
        check(WINDOW, 1e-3, 0.05);
    }

    #[test]
    fn a_moving_point_is_found_out_and_does_not_disturb() {
        let (mut window, mut landmarks) = scene(6, 0.0);
        for i in 0..6 {
            let seen = landmarks[7].seen_by(i).expect("seen by all");
            landmarks[7].record(i, &(seen + Vector2::new(0.02 * i as f64 * i as f64, 0.01 * i as f64)));
        }
        let mut system = Box::new(ReducedSystem::new());
        let report = adjust(&mut window, &mut landmarks, None, &mut system, &SETTINGS);
        assert_eq!((report.n_outliers, landmarks[7].is_outlier), (1, true));
        assert!(worst_pose_error(&window, 6) < 0.01);
    }

    #[test]
    fn a_prior_holds_a_keyframe_that_sees_little() {
        let check = |sigma: f64, expected: std::ops::Range<f64>| {
            let (mut window, mut landmarks) = scene(4, 0.0);
            // The newest keyframe has one sighting, and it is wrong.
            for landmark in &mut landmarks {
                landmark.forget(3, |_| None);
            }
            let seen = landmarks[7].seen_by(2).expect("seen") + Vector2::new(0.02, 0.0);
            landmarks[7].record(3, &seen);
            let prior = PosePrior { camera_from_world: truth(3), information: Matrix6::identity() / (sigma * sigma) };
            adjust(&mut window, &mut landmarks, Some(&prior), &mut Box::new(ReducedSystem::new()), &SETTINGS);
            let off = se3::log(&(window.at(3).expect("filled").camera_from_world * truth(3).inverse())).norm();
            assert!(expected.contains(&off), "{sigma}: {off}");
        };
        check(1e-4, 0.0..1e-3);
        check(10.0, 5e-3..10.0);
    }

    #[test]
    fn two_keyframes_are_left_alone() {
        let (mut window, mut landmarks) = scene(2, 0.0);
        let before = window.at(1).copied();
        let report = adjust(&mut window, &mut landmarks, None, &mut Box::new(ReducedSystem::new()), &SETTINGS);
        assert_eq!((report.stop, window.at(1).copied()), (Stop::Stalled, before));
    }

    #[test]
    fn keyframes_of_a_turn_on_the_spot_hold_no_scale() {
        let check = |ways_m: &[f64], expected: usize| {
            let mut window = KeyframeWindow::new();
            for way_m in ways_m {
                window.push(0, 0, Rigid::translation(0.0, 0.0, -way_m), &mut []);
            }
            assert_eq!(n_fixed(&window), expected, "{ways_m:?}");
        };
        check(&[0.0, 1.0, 2.0], 2);
        check(&[0.0, 0.01, 0.0, 1.0, 2.0], 4);
        check(&[0.0, 0.0, 0.0], 4);
        check(&[], 0);
    }

    #[test]
    fn derivatives_agree_with_differences() {
        let host = truth(0);
        let target = truth(3);
        let ray = Vector3::new(0.2, -0.1, 1.0);
        let seen = Vector2::new(0.1, 0.0);
        let at = |dh: Vector6<f64>, dt: Vector6<f64>, rho: f64| {
            let target_from_host = (se3::exp(&dt) * target) * (se3::exp(&dh) * host).inverse();
            equations::Sighting::new(&target_from_host, &ray, rho, &seen).expect("in front")
        };
        let here = at(Vector6::zeros(), Vector6::zeros(), 0.05);
        for k in 0..6 {
            let mut d = Vector6::zeros();
            d[k] = 1e-6;
            let by_host = (at(d, Vector6::zeros(), 0.05).residual - at(-d, Vector6::zeros(), 0.05).residual) / 2e-6;
            let by_target = (at(Vector6::zeros(), d, 0.05).residual - at(Vector6::zeros(), -d, 0.05).residual) / 2e-6;
            assert!((by_host - here.by_host.column(k)).norm() < 1e-7, "host {k}");
            assert!((by_target - here.by_target.column(k)).norm() < 1e-7, "target {k}");
        }
        let zero = Vector6::zeros();
        let by_depth = (at(zero, zero, 0.05 + 1e-6).residual - at(zero, zero, 0.05 - 1e-6).residual) / 2e-6;
        assert!((by_depth - here.by_depth).norm() < 1e-7);
    }
}
