//! A tracker on storage of its own.

use kilogs_core::bundle::ReducedSystem;
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::correspondence::PixelMatch;
use kilogs_core::features::SimdLevel;
use kilogs_core::features::corners::Corner;
use kilogs_core::features::lk::Flow;
use kilogs_core::features::tracks::{Track, TrackStorage};
use kilogs_core::keyframe::Landmark;
use kilogs_core::pose::{LandmarkMatch, Match};
use kilogs_core::tracking::{KeyframePoint, N_PYRAMIDS, Tracker, TrackerCapacities, TrackerStorage, TrackingSettings};

/// Hands a tracker with standard settings to `drive`.
pub fn with_tracker<R>(camera: Pinhole, mounting: Mounting, seed: u64, drive: impl FnOnce(&mut Tracker<'_>) -> R) -> R {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let capacities = TrackerCapacities { width, height, tracks: 2048, landmarks: 8192 };
    let n = capacities.tracks;
    let mut pyramids = vec![vec![0; capacities.bytes_per_pyramid()]; N_PYRAMIDS];
    let [first, second, third] = &mut pyramids[..] else { unreachable!("{N_PYRAMIDS} pyramids") };
    let point = KeyframePoint { pixel: [0.0; 2], depth_m: 0.0, relative_sigma: 0.0 };
    let storage = TrackerStorage {
        pyramids: [first, second, third],
        tracks: TrackStorage {
            tracks: &mut vec![Track::NONE; n],
            at_keyframe: &mut vec![Track::NONE; n],
            flows: &mut vec![Flow::new([0.0; 2], [0.0; 2]); n],
            corners: &mut vec![Corner::NONE; n],
            distances_px: &mut vec![0.0; n],
        },
        landmarks: &mut vec![Landmark::default(); capacities.landmarks],
        pixel_matches: &mut vec![PixelMatch::default(); n],
        matches: &mut vec![Match::default(); n],
        landmark_matches: &mut vec![LandmarkMatch::default(); n],
        is_inlier: &mut vec![false; n],
        landmark_of_track: &mut vec![0; n],
        landmark_of_match: &mut vec![0; n],
        keyframe_points: &mut vec![point; n],
        bundle: &mut Box::new(ReducedSystem::new()),
    };
    let settings = TrackingSettings::STANDARD;
    let tracker = Tracker::new(camera, mounting, settings, SimdLevel::new(), seed, storage);
    drive(&mut tracker.expect("the storage is as large as the capacities say"))
}
