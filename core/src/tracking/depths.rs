//! New depths, and what of the window does not belong to a still street.

use super::TrackingSettings;
use crate::camera::Pinhole;
use crate::keyframe::{KeyframeWindow, Landmark, LandmarkView, SHORTEST_BASELINE_M, WINDOW};
use crate::pose::{Sighting, triangulate_inverse_depth};
use nalgebra::Vector3;

/// Landmarks are tested against this many standard deviations of their depth.
const SIGMAS: f64 = 3.0;
/// Triangulates landmarks that have at least two sightings and no depth yet; returns how many got one.
pub(super) fn triangulate_new(
    window: &KeyframeWindow,
    landmarks: &mut [Landmark],
    camera: &Pinhole,
    settings: &TrackingSettings,
) -> usize {
    let noise_z1 = settings.noise_z1(camera);
    let mut n = 0;
    for landmark in landmarks.iter_mut().filter(|l| !l.has_depth() && !l.is_outlier && l.n_sightings() > 1) {
        let Some(host) = window.at(landmark.host()) else { continue };
        let world_from_host = host.camera_from_world.inverse();
        let mut sightings = heapless::Vec::<Sighting, WINDOW>::new();
        let mut longest_m = 0.0_f64;
        for column in landmark.columns().filter(|&c| c != landmark.host()) {
            if let (Some(keyframe), Some(seen_z1)) = (window.at(column), landmark.seen_by(column)) {
                let camera_from_host = keyframe.camera_from_world * world_from_host;
                longest_m = longest_m.max(camera_from_host.translation.vector.norm());
                let _ = sightings.push(Sighting { camera_from_host, seen_z1 });
            }
        }
        if longest_m < SHORTEST_BASELINE_M {
            continue;
        }
        let host_z1 = landmark.host_ray().xy();
        let Some(found) = triangulate_inverse_depth(&host_z1, sightings.iter(), 0.0, noise_z1) else { continue };
        if found.rms_z1 > settings.outlier_sigmas * noise_z1 || found.value < -SIGMAS * found.sigma {
            landmark.is_outlier = true;
        } else {
            (landmark.inverse_depth, landmark.sigma) = (found.value, found.sigma);
            n += 1;
        }
    }
    n
}

/// Marks landmarks that would have to lie well below the road or behind the newest camera, so that they must have
/// moved; returns how many.
pub(super) fn mark_impossible(
    window: &KeyframeWindow,
    landmarks: &mut [Landmark],
    road_normal: &Vector3<f64>,
    height_m: f64,
    below_road_ratio: f64,
) -> usize {
    let Some(newest) = window.newest().map(|k| k.camera_from_world) else { return 0 };
    let mut n = 0;
    for landmark in landmarks.iter_mut().filter(|l| l.is_tracked && l.has_depth() && !l.is_outlier) {
        let Some(LandmarkView { z1, inverse_depth, sigma }) = window.landmark_in(landmark, &newest) else {
            landmark.is_outlier = true;
            n += 1;
            continue;
        };
        let road_inverse_depth = road_normal.dot(&Vector3::new(z1.x, z1.y, 1.0)) / height_m;
        let most = inverse_depth + SIGMAS * sigma;
        if most < 0.0 || most < below_road_ratio * road_inverse_depth {
            landmark.is_outlier = true;
            n += 1;
        }
    }
    n
}
