//! Residuals, derivatives and the elimination of the depths.

use super::{BundleSettings, ReducedSystem};
use crate::conventions::Rigid;
use crate::keyframe::{Column, KeyframeWindow, Landmark, WINDOW};
use crate::math::se3;
use crate::math::se3::skew;
use nalgebra::{Matrix2x3, Matrix2x6, Matrix6, Rotation3, Vector2, Vector3, Vector6};

/// Below this information about its depth a landmark's depth is held where it is.
const MIN_DEPTH_INFORMATION: f64 = 1e-9;

/// The window's poses by column, and which of them may move.
#[derive(Clone)]
pub(super) struct Graph {
    camera_from_world: [Option<Rigid>; WINDOW],
    /// Motions between the columns: target, then host.
    target_from_host: [[Option<Rigid>; WINDOW]; WINDOW],
    /// Place of each column among the unknowns.
    free: [Option<usize>; WINDOW],
    n_free: usize,
}

impl Graph {
    pub(super) fn new(window: &KeyframeWindow, n_fixed: usize) -> Self {
        let mut graph = Self {
            camera_from_world: [None; WINDOW],
            target_from_host: [[None; WINDOW]; WINDOW],
            free: [None; WINDOW],
            n_free: 0,
        };
        for (age, column) in window.columns_by_age().enumerate() {
            graph.camera_from_world[column] = window.at(column).map(|k| k.camera_from_world);
            if age >= n_fixed {
                graph.free[column] = Some(graph.n_free);
                graph.n_free += 1;
            }
        }
        graph.relate();
        graph
    }

    /// Renews the motions between the columns.
    fn relate(&mut self) {
        let world_from_host = self.camera_from_world.map(|pose| pose.map(|p| p.inverse()));
        for (row, pose) in self.target_from_host.iter_mut().zip(&self.camera_from_world) {
            for (motion, world_from_host) in row.iter_mut().zip(&world_from_host) {
                *motion = pose.as_ref().zip(world_from_host.as_ref()).map(|(pose, inverse)| pose * inverse);
            }
        }
    }

    pub(super) fn n_free(&self) -> usize {
        self.n_free
    }

    /// Place of a column among the unknowns, `None` where it is held.
    pub(super) fn place(&self, column: Column) -> Option<usize> {
        self.free.get(column).copied().flatten()
    }

    pub(super) fn pose(&self, column: Column) -> Option<Rigid> {
        self.camera_from_world.get(column).copied().flatten()
    }

    /// Moves the free poses by left increments.
    pub(super) fn apply(&mut self, step: &[Vector6<f64>; WINDOW]) {
        for (pose, free) in self.camera_from_world.iter_mut().zip(self.free) {
            if let (Some(pose), Some(place)) = (pose, free) {
                *pose = se3::exp(&step[place]) * *pose;
                pose.rotation.renormalize();
            }
        }
        self.relate();
    }

    /// Keyframes other than its host that see a landmark, with their motion from the host and what they see.
    fn views<'a>(&'a self, landmark: &'a Landmark) -> impl Iterator<Item = (Column, &'a Rigid, Vector2<f64>)> + 'a {
        let host = landmark.host();
        landmark.columns().filter(move |&c| c != host).filter_map(move |column| {
            let target_from_host = self.target_from_host.get(column)?.get(host)?.as_ref()?;
            Some((column, target_from_host, landmark.seen_by(column)?))
        })
    }

    /// Sightings of a landmark by other keyframes than its host.
    fn sightings<'a>(&'a self, landmark: &'a Landmark) -> impl Iterator<Item = (Column, Sighting)> + 'a {
        let (ray, inverse_depth) = (landmark.host_ray(), landmark.inverse_depth);
        self.views(landmark).filter_map(move |(column, target_from_host, seen)| {
            Some((column, Sighting::new(target_from_host, &ray, inverse_depth, &seen)?))
        })
    }
}

/// A host's ray in a target camera, scaled by the inverse depth; `None` behind it.
fn in_target(
    target_from_host: &Rigid,
    rotation: &Rotation3<f64>,
    ray: &Vector3<f64>,
    inverse_depth: f64,
) -> Option<Vector3<f64>> {
    let q = rotation * ray + target_from_host.translation.vector * inverse_depth;
    (q.z > 0.0).then_some(q)
}

/// One reprojection with its derivatives.
pub(super) struct Sighting {
    pub(super) residual: Vector2<f64>,
    pub(super) by_host: Matrix2x6<f64>,
    pub(super) by_target: Matrix2x6<f64>,
    pub(super) by_depth: Vector2<f64>,
}

impl Sighting {
    /// `None` behind the target camera.
    pub(super) fn new(
        target_from_host: &Rigid,
        ray: &Vector3<f64>,
        inverse_depth: f64,
        seen_z1: &Vector2<f64>,
    ) -> Option<Self> {
        let t = target_from_host.translation.vector;
        let rotation = target_from_host.rotation.to_rotation_matrix();
        let q = in_target(target_from_host, &rotation, ray, inverse_depth)?;
        let p = q.xy() / q.z;
        let by_q = Matrix2x3::new(1.0, 0.0, -p.x, 0.0, 1.0, -p.y) / q.z;
        let by_q_and_rotation = by_q * rotation.matrix();
        let (mut by_host, mut by_target) = (Matrix2x6::zeros(), Matrix2x6::zeros());
        by_target.fixed_columns_mut::<3>(0).copy_from(&(-by_q * skew(&q)));
        by_target.fixed_columns_mut::<3>(3).copy_from(&(by_q * inverse_depth));
        by_host.fixed_columns_mut::<3>(0).copy_from(&(by_q_and_rotation * skew(ray)));
        by_host.fixed_columns_mut::<3>(3).copy_from(&(by_q_and_rotation * -inverse_depth));
        Some(Self { residual: p - seen_z1, by_host, by_target, by_depth: by_q * t })
    }
}

/// Huber's weight over the variance, and the robust cost.
fn weight_and_cost(residual: &Vector2<f64>, settings: &BundleSettings) -> (f64, f64) {
    let sigmas = residual.norm() / settings.noise_z1;
    let precision = 1.0 / (settings.noise_z1 * settings.noise_z1);
    let width = settings.huber_sigmas;
    if sigmas <= width {
        (precision, sigmas * sigmas)
    } else {
        (precision * width / sigmas, width * (2.0 * sigmas - width))
    }
}

fn is_adjustable(landmark: &Landmark) -> bool {
    landmark.has_depth() && !landmark.is_outlier && landmark.n_sightings() > 1
}

/// Whether a landmark has a say in the poses.
fn is_evidence(landmark: &Landmark, settings: &BundleSettings) -> bool {
    is_adjustable(landmark) && landmark.n_sightings() >= settings.min_sightings
}

/// Sums over one landmark: its depth's information and gradient, and its coupling with every free pose.
struct DepthRow {
    information: f64,
    gradient: f64,
    coupling: [Vector6<f64>; WINDOW],
    is_coupled: [bool; WINDOW],
}

impl DepthRow {
    fn new() -> Self {
        Self { information: 0.0, gradient: 0.0, coupling: [Vector6::zeros(); WINDOW], is_coupled: [false; WINDOW] }
    }

    fn add(&mut self, graph: &Graph, host: Column, target: Column, s: &Sighting, weight: f64) {
        self.information += weight * s.by_depth.norm_squared();
        self.gradient += weight * s.by_depth.dot(&s.residual);
        for (column, by_pose) in [(host, &s.by_host), (target, &s.by_target)] {
            if let Some(place) = graph.free[column] {
                self.coupling[place] += by_pose.tr_mul(&s.by_depth) * weight;
                self.is_coupled[place] = true;
            }
        }
    }

    /// Step of the depth that goes with a step of the poses.
    fn step(&self, poses: &[Vector6<f64>; WINDOW], damping: f64) -> f64 {
        if self.information <= MIN_DEPTH_INFORMATION {
            return 0.0;
        }
        let coupled: f64 = self.coupling.iter().zip(poses).map(|(c, p)| c.dot(p)).sum();
        -(self.gradient + coupled) / (self.information * (1.0 + damping))
    }
}

/// Fills the reduced system at the graph's poses and the landmarks' depths.
pub(super) fn linearize(
    graph: &Graph,
    landmarks: &[Landmark],
    settings: &BundleSettings,
    damping: f64,
    system: &mut ReducedSystem,
) {
    system.clear();
    for landmark in landmarks.iter().filter(|l| is_evidence(l, settings)) {
        let host = landmark.host();
        let mut row = DepthRow::new();
        for (target, s) in graph.sightings(landmark) {
            let weight = weight_and_cost(&s.residual, settings).0;
            row.add(graph, host, target, &s, weight);
            let (host_place, target_place) = (graph.free[host], graph.free[target]);
            if let Some(h) = host_place {
                system.add_block(h, h, &(s.by_host.tr_mul(&s.by_host) * weight));
                system.add_gradient(h, &(s.by_host.tr_mul(&s.residual) * weight));
            }
            if let Some(t) = target_place {
                system.add_block(t, t, &(s.by_target.tr_mul(&s.by_target) * weight));
                system.add_gradient(t, &(s.by_target.tr_mul(&s.residual) * weight));
            }
            if let (Some(h), Some(t)) = (host_place, target_place) {
                let block: Matrix6<f64> = s.by_target.tr_mul(&s.by_host) * weight;
                if t > h { system.add_block(t, h, &block) } else { system.add_block(h, t, &block.transpose()) }
            }
        }
        eliminate(&row, damping, system);
    }
}

/// Schur complement of one depth.
fn eliminate(row: &DepthRow, damping: f64, system: &mut ReducedSystem) {
    if row.information <= MIN_DEPTH_INFORMATION {
        return;
    }
    let inverse = 1.0 / (row.information * (1.0 + damping));
    for a in (0..WINDOW).filter(|&a| row.is_coupled[a]) {
        system.add_gradient(a, &(row.coupling[a] * (-row.gradient * inverse)));
        for b in (0..=a).filter(|&b| row.is_coupled[b]) {
            system.add_block(a, b, &(row.coupling[a] * row.coupling[b].transpose() * -inverse));
        }
    }
}

fn depth_row(graph: &Graph, landmark: &Landmark, settings: &BundleSettings) -> DepthRow {
    let mut row = DepthRow::new();
    for (target, s) in graph.sightings(landmark) {
        row.add(graph, landmark.host(), target, &s, weight_and_cost(&s.residual, settings).0);
    }
    row
}

/// Moves every depth by the step that goes with the poses' step; [`restore_depths`] takes it back.
pub(super) fn move_depths(
    graph: &Graph,
    poses: &[Vector6<f64>; WINDOW],
    landmarks: &mut [Landmark],
    settings: &BundleSettings,
    damping: f64,
) {
    for landmark in landmarks.iter_mut().filter(|l| is_adjustable(l)) {
        let step = depth_row(graph, landmark, settings).step(poses, damping);
        landmark.kept_inverse_depth = landmark.inverse_depth;
        landmark.inverse_depth += step;
    }
}

/// Takes back the last [`move_depths`].
pub(super) fn restore_depths(landmarks: &mut [Landmark]) {
    for landmark in landmarks.iter_mut().filter(|l| is_adjustable(l)) {
        landmark.inverse_depth = landmark.kept_inverse_depth;
    }
}

/// Robust cost of all sightings that have a say in the poses; those behind a camera cost as much as a gross outlier.
pub(super) fn total_cost(graph: &Graph, landmarks: &[Landmark], settings: &BundleSettings) -> f64 {
    const BEHIND_SIGMAS: f64 = 100.0;
    let behind = settings.huber_sigmas * (2.0 * BEHIND_SIGMAS - settings.huber_sigmas);
    let mut cost = 0.0;
    for landmark in landmarks.iter().filter(|l| is_evidence(l, settings)) {
        let mut n_in_front = 1;
        let ray = landmark.host_ray();
        for (_, target_from_host, seen) in graph.views(landmark) {
            let rotation = target_from_host.rotation.to_rotation_matrix();
            let Some(q) = in_target(target_from_host, &rotation, &ray, landmark.inverse_depth) else { continue };
            cost += weight_and_cost(&(q.xy() / q.z - seen), settings).1;
            n_in_front += 1;
        }
        cost += behind * f64::from(landmark.n_sightings().saturating_sub(n_in_front));
    }
    cost
}

/// Renews the depths' uncertainty and marks the landmarks that do not fit; returns their number.
pub(super) fn finish(graph: &Graph, landmarks: &mut [Landmark], settings: &BundleSettings) -> usize {
    let mut n_outliers = 0;
    for landmark in landmarks.iter_mut().filter(|l| is_adjustable(l)) {
        let (mut sum2, mut n) = (0.0, 0);
        let mut information = 0.0;
        for (_, s) in graph.sightings(landmark) {
            sum2 += s.residual.norm_squared();
            information += s.by_depth.norm_squared();
            n += 1;
        }
        let limit = settings.outlier_sigmas * settings.noise_z1;
        if n == 0 || !landmark.inverse_depth.is_finite() || sum2 > limit * limit * f64::from(n) {
            landmark.is_outlier = true;
            n_outliers += 1;
        } else if information > 0.0 {
            landmark.sigma = settings.noise_z1 / libm::sqrt(information);
        }
    }
    n_outliers
}
