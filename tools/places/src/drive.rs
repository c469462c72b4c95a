//! A recording through the tracker: its keyframes, with what recognition needs of them.

use crate::error::PlacesError;
use crate::frames::{Extractor, Frames};
use kilogs_core::bundle::ReducedSystem;
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::correspondence::PixelMatch;
use kilogs_core::features::corners::Corner;
use kilogs_core::features::lk::Flow;
use kilogs_core::features::tracks::{Track, TrackStorage};
use kilogs_core::features::{Feature, SimdLevel};
use kilogs_core::keyframe::Landmark;
use kilogs_core::places::{PointDepth, describe_points};
use kilogs_core::pose::{LandmarkMatch, Match};
use kilogs_core::tracking::{KeyframePoint, N_PYRAMIDS, Tracker, TrackerCapacities, TrackerStorage, TrackingSettings};

/// A keyframe of a drive.
pub(crate) struct Keyframe {
    /// Index of its frame in the recording.
    pub frame: u64,
    /// Where it stands by odometry.
    pub odometry_from_camera: Rigid,
    /// What its words are made of.
    pub features: Vec<Feature>,
    /// The points that a verification needs: what they look like,
    pub points: Vec<Feature>,
    /// and how far they are.
    pub depths: Vec<PointDepth>,
}

/// A frame of a drive.
pub(crate) struct Frame {
    /// When it was taken, s.
    pub time_s: f64,
    /// Index of the keyframe that it follows; none before the first.
    pub keyframe: Option<usize>,
    /// Where it stands by odometry.
    pub odometry_from_camera: Rigid,
}

/// A recording as it was tracked.
pub(crate) struct Tracked {
    /// Of all its images.
    pub camera: Pinhole,
    /// The keyframes that were tracked.
    pub keyframes: Vec<Keyframe>,
    /// All frames.
    pub frames: Vec<Frame>,
}

const N_TRACKS: usize = 2048;
const N_LANDMARKS: usize = 8192;
const SECONDS_PER_NS: f64 = 1e-9;

/// Tracks a recording whose first frame is `first_frame` of the whole.
pub(crate) fn keyframes(
    mut frames: Frames,
    first_frame: u64,
    n_features: usize,
    n_points: usize,
) -> Result<Tracked, PlacesError> {
    let format = frames.format();
    let camera = format.camera;
    let capacities = TrackerCapacities {
        width: camera.width as usize,
        height: camera.height as usize,
        tracks: N_TRACKS,
        landmarks: N_LANDMARKS,
    };
    let mut pyramids = vec![vec![0; capacities.bytes_per_pyramid()]; N_PYRAMIDS];
    let [first, second, third] = &mut pyramids[..] else {
        return Ok(Tracked { camera, keyframes: vec![], frames: vec![] });
    };
    let no_point = KeyframePoint { pixel: [0.0; 2], depth_m: 0.0, relative_sigma: 0.0 };
    let storage = TrackerStorage {
        pyramids: [first, second, third],
        tracks: TrackStorage {
            tracks: &mut vec![Track::NONE; N_TRACKS],
            at_keyframe: &mut vec![Track::NONE; N_TRACKS],
            flows: &mut vec![Flow::new([0.0; 2], [0.0; 2]); N_TRACKS],
            corners: &mut vec![Corner::NONE; N_TRACKS],
            distances_px: &mut vec![0.0; N_TRACKS],
        },
        landmarks: &mut vec![Landmark::default(); N_LANDMARKS],
        pixel_matches: &mut vec![PixelMatch::default(); N_TRACKS],
        matches: &mut vec![Match::default(); N_TRACKS],
        landmark_matches: &mut vec![LandmarkMatch::default(); N_TRACKS],
        is_inlier: &mut vec![false; N_TRACKS],
        landmark_of_track: &mut vec![0; N_TRACKS],
        landmark_of_match: &mut vec![0; N_TRACKS],
        keyframe_points: &mut vec![no_point; N_TRACKS],
        bundle: &mut Box::new(ReducedSystem::new()),
    };
    let (simd, settings) = (SimdLevel::new(), TrackingSettings::STANDARD);
    let mounting = format.mounting.ok_or(PlacesError::NoMounting)?;
    let mut tracker = Tracker::new(camera, mounting, settings, simd, 0, storage)?;
    let mut extractor = Extractor::new(&format, n_features);
    let (mut keyframes, mut tracked) = (Vec::new(), Vec::new());
    let (mut points, mut depths) = (vec![Feature::NONE; n_points], vec![PointDepth::default(); n_points]);
    let mut frame = first_frame;
    while let Some((image, info)) = frames.next()? {
        let report = tracker.step(image, frame, info.timestamp_ns + 1);
        if report.is_tracked_keyframe() {
            let seen = tracker.keyframe_points();
            let (features, n) =
                extractor.look(image, |pyramid| describe_points(simd, pyramid, seen, &mut points, &mut depths))?;
            keyframes.push(Keyframe {
                frame,
                odometry_from_camera: report.world_from_camera,
                features: features.to_vec(),
                points: points[..n].to_vec(),
                depths: depths[..n].to_vec(),
            });
        }
        tracked.push(Frame {
            time_s: info.timestamp_ns as f64 * SECONDS_PER_NS,
            keyframe: keyframes.len().checked_sub(1),
            odometry_from_camera: report.world_from_camera,
        });
        frame += 1;
    }
    Ok(Tracked { camera, keyframes, frames: tracked })
}
