//! What helps when tracks give no pose that can be believed.
//!
//! Tracks -> (refused) -> sparse matches -> (refused) -> dense matches -> (refused) -> the motion model's prediction.
//! Matches become tracks of the keyframe again, so that one solver serves all of them and a landmark lives on.

use super::frame_pose::FramePose;
use super::matches::z1_of;
use super::tracker::Tracker;
use crate::correspondence::{DepthPrior, ImagePair, PairMatcher};
use crate::features::tracks::{TrackImages, TrackReport};
use crate::pose::{Match, RelativePose, essential_of, sampson_distance};
use core::fmt;

/// Where the matches of a frame with its keyframe came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MatchSource {
    /// Tracks.
    Tracks,
    /// A matcher of few, distinct points.
    Sparse,
    /// A matcher of the whole image.
    Dense,
}

/// Metres that the vehicle drove since the frame before, from its wheels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Travelled {
    /// Way of the rear axle, m; not negative.
    pub metres: f64,
    /// Its standard deviation, m.
    pub sigma_m: f64,
}

impl Travelled {
    /// No way at all.
    pub(super) const NOTHING: Self = Self { metres: 0.0, sigma_m: 0.0 };
}

/// What a caller can lend to a step; nothing by default.
#[derive(Default)]
pub struct Aids<'a> {
    /// Asked when tracks give no pose that is believed.
    pub sparse: Option<&'a mut dyn PairMatcher>,
    /// Asked when neither tracks nor sparse matches do.
    pub dense: Option<&'a mut dyn PairMatcher>,
    /// Asked for the scale at keyframes.
    pub depth: Option<&'a mut dyn DepthPrior>,
    /// What the wheels say.
    pub travelled: Option<Travelled>,
}

impl fmt::Debug for Aids<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [sparse, dense] = [&self.sparse, &self.dense].map(Option::is_some);
        write!(f, "Aids {{ sparse: {sparse}, dense: {dense}, depth: {}, ", self.depth.is_some())?;
        write!(f, "travelled: {:?} }}", self.travelled)
    }
}

impl<'a> Aids<'a> {
    /// Whether lost tracks can be found again.
    pub(super) fn can_match(&self) -> bool {
        self.sparse.is_some() || self.dense.is_some()
    }

    fn matcher(&mut self, source: MatchSource) -> Option<&mut (dyn PairMatcher + 'a)> {
        match source {
            MatchSource::Tracks => None,
            MatchSource::Sparse => self.sparse.as_deref_mut(),
            MatchSource::Dense => self.dense.as_deref_mut(),
        }
    }
}

impl Tracker<'_> {
    /// Replaces the tracks by what a matcher finds in the keyframe and the current frame; whether there was one.
    pub(super) fn rematch(&mut self, source: MatchSource, aids: &mut Aids<'_>, report: &mut TrackReport) -> bool {
        let Some(matcher) = aids.matcher(source) else { return false };
        let keyframe = &self.pyramids[self.keyframe_slot];
        let current = &self.pyramids[self.current_slot];
        let pair = ImagePair { keyframe, keyframe_ordinal: self.newest.ordinal, current };
        let n = matcher.match_pair(&pair, self.scratch.pixel_matches);
        let matches = self.scratch.pixel_matches.get(..n).unwrap_or(&[]);
        let images = TrackImages { keyframe, previous: &self.pyramids[self.previous_slot], current };
        let reseeded = self.tracks.reseed(self.simd, images, matches, &self.settings.tracks);
        (report.n_live, report.median_flow_px) = (self.tracks.tracks().len(), reseeded.median_flow_px);
        self.revive_landmarks();
        if let Some(column) = self.window.columns_by_age().last() {
            self.adopt_new_tracks(column);
        }
        true
    }

    /// Ends the tracks that matches started and the pose contradicts: no solver has looked at those without a landmark,
    /// and the bundle adjustment would take their depths for granted.
    pub(super) fn drop_contradicted(&mut self, pose: &FramePose) {
        let camera_from_keyframe = pose.camera_from_world * self.newest.camera_from_world.inverse();
        let step_m = camera_from_keyframe.translation.vector.norm();
        if pose.source == MatchSource::Tracks || step_m < self.settings.motion.min_step_m {
            return;
        }
        let (rotation, direction) = (camera_from_keyframe.rotation, camera_from_keyframe.translation.vector / step_m);
        let motion = RelativePose { rotation, direction };
        let essential = essential_of(&motion);
        let sigmas = self.settings.pnp_inlier_sigmas;
        let most_z1 = sigmas * self.settings.noise_px_of(pose.source) / self.camera.fx;
        let camera = self.camera;
        self.tracks.retain(|track| {
            let m = Match { first_z1: z1_of(&camera, track.keyframe_px), second_z1: z1_of(&camera, track.current_px) };
            sampson_distance(&essential, &m).abs() < most_z1 && motion.in_front_of_both(&m)
        });
        self.link_landmarks();
    }

    /// Landmarks whose tracks live again.
    fn revive_landmarks(&mut self) {
        let tracks = self.tracks.tracks();
        for landmark in self.landmarks.iter_mut().filter(|l| l.is_used()) {
            landmark.is_tracked = tracks.binary_search_by_key(&landmark.track_id, |t| t.id).is_ok();
        }
    }
}
