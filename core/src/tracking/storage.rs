//! The memory that a tracker works in: counted by the budget, handed in by the caller.

use super::{KeyframePoint, Tracker};
use crate::bundle::ReducedSystem;
use crate::correspondence::PixelMatch;
use crate::features::corners::Corner;
use crate::features::lk::Flow;
use crate::features::tracks::{Track, TrackStorage};
use crate::frame::pyramid;
use crate::keyframe::Landmark;
use crate::pose::{LandmarkMatch, Match};
use core::fmt;

/// Pyramids that a tracker holds: the last keyframe, the frame before the current one, the current one.
pub const N_PYRAMIDS: usize = 3;

/// How much a tracker can hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrackerCapacities {
    /// Image width, px.
    pub width: usize,
    /// Image height, px.
    pub height: usize,
    /// Tracks alive at once. When full, the weakest new corners are refused.
    pub tracks: usize,
    /// Landmarks of the window, alive or not. When full, new ones are refused.
    pub landmarks: usize,
}

impl TrackerCapacities {
    /// Bytes of one pyramid.
    pub fn bytes_per_pyramid(&self) -> usize {
        pyramid::bytes_needed(self.width, self.height, super::tracker::PYRAMID_LEVELS)
    }

    /// Bytes of all slices of a [`TrackerStorage`].
    pub fn bytes(&self) -> usize {
        N_PYRAMIDS * self.bytes_per_pyramid()
            + self.tracks * BYTES_PER_TRACK
            + self.landmarks * BYTES_PER_LANDMARK
            + size_of::<ReducedSystem>()
    }
}

/// How full a tracker's storage is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TrackerFill {
    /// Pyramids that have held an image.
    pub pyramids: usize,
    /// Landmarks in use.
    pub landmarks: usize,
    /// Keyframes in the window.
    pub keyframes: usize,
}

/// Bytes per track: the track, the scratch of its search, its matches and its published point.
pub const BYTES_PER_TRACK: usize = 2 * size_of::<Track>()
    + size_of::<PixelMatch>()
    + size_of::<Flow>()
    + size_of::<Corner>()
    + size_of::<f32>()
    + size_of::<Match>()
    + size_of::<LandmarkMatch>()
    + size_of::<bool>()
    + 2 * size_of::<u32>()
    + size_of::<KeyframePoint>();

/// Bytes per landmark.
pub const BYTES_PER_LANDMARK: usize = size_of::<Landmark>();

/// Memory of a tracker. Everything but `pyramids` and `landmarks` is as long as `tracks.tracks`.
#[derive(Debug)]
pub struct TrackerStorage<'m> {
    /// Pixels of three pyramids, each of [`TrackerCapacities::bytes_per_pyramid`].
    pub pyramids: [&'m mut [u8]; N_PYRAMIDS],
    /// Tracks with their scratch; their length bounds how many live at once.
    pub tracks: TrackStorage<'m>,
    /// Landmarks of the window.
    pub landmarks: &'m mut [Landmark],
    /// Scratch: what a matcher found.
    pub pixel_matches: &'m mut [PixelMatch],
    /// Scratch: matches of the current frame with the keyframe.
    pub matches: &'m mut [Match],
    /// Scratch: landmarks seen by the current frame.
    pub landmark_matches: &'m mut [LandmarkMatch],
    /// Scratch: verdict per match.
    pub is_inlier: &'m mut [bool],
    /// Scratch: landmark of each track.
    pub landmark_of_track: &'m mut [u32],
    /// Scratch: landmark of each landmark match.
    pub landmark_of_match: &'m mut [u32],
    /// Published points of the newest keyframe.
    pub keyframe_points: &'m mut [KeyframePoint],
    /// Work space of the bundle adjustment.
    pub bundle: &'m mut ReducedSystem,
}

impl TrackerStorage<'_> {
    /// Length of the shortest slice that has to be as long as the tracks, and the length needed.
    pub(super) fn shortest(&self) -> (usize, usize) {
        let needed = self.tracks.tracks.len();
        let shortest = [
            self.pixel_matches.len(),
            self.matches.len(),
            self.landmark_matches.len(),
            self.is_inlier.len(),
            self.landmark_of_track.len(),
            self.landmark_of_match.len(),
            self.keyframe_points.len(),
        ]
        .into_iter()
        .fold(usize::MAX, usize::min);
        (shortest, needed)
    }
}

/// The slices of a [`TrackerStorage`] do not fit the capacities: a mistake of the caller, to be mended there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrackerStorageProblem {
    /// What was too small.
    pub what: &'static str,
    /// Its size: elements, or bytes of a pyramid.
    pub found: usize,
    /// The size needed.
    pub needed: usize,
}

impl fmt::Display for TrackerStorageProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "tracker storage: {} has {}, {} needed", self.what, self.found, self.needed)
    }
}

impl core::error::Error for TrackerStorageProblem {}

impl Tracker<'_> {
    /// What this tracker's storage holds.
    pub fn capacities(&self) -> TrackerCapacities {
        TrackerCapacities {
            width: self.camera.width as usize,
            height: self.camera.height as usize,
            tracks: self.tracks.capacity(),
            landmarks: self.landmarks.len(),
        }
    }

    /// How much of it is in use.
    pub fn fill(&self) -> TrackerFill {
        TrackerFill {
            pyramids: self.n_slots_used,
            landmarks: self.landmarks.iter().filter(|l| l.is_used()).count(),
            keyframes: self.window.len(),
        }
    }
}
