//! The beginning and the end of a window.

use super::drift::Drift;
use super::frame_pose::FramePose;
use super::tracker::Tracker;
use super::{FrameStatus, PoseModel, StatusReason, Travelled};
use crate::conventions::{Rigid, TimestampNs};

impl Tracker<'_> {
    /// Opens a window at the predicted pose, if the image has something to hold on to.
    pub(super) fn start_window(&mut self, frame_index: u64, timestamp_ns: TimestampNs, predicted: &Rigid) -> FramePose {
        let is_first_ever = self.window.next_ordinal() == 0;
        self.tracks.clear();
        let current = &self.pyramids[self.current_slot];
        let found = self.tracks.promote(self.simd, current, &self.settings.tracks).n_found;
        if found < self.settings.min_corners {
            self.tracks.clear();
            return FramePose::lost(&self.motion, StatusReason::TooFewMatches);
        }
        (self.keyframe_slot, self.previous_slot) = (self.current_slot, self.current_slot);
        let column = self.window.push(frame_index, timestamp_ns, *predicted, self.landmarks);
        self.adopt_new_tracks(column);
        self.note_newest();
        self.travelled = Some(Travelled::NOTHING);
        let pose = FramePose::predicted(predicted);
        self.drift = if is_first_ever { Drift::none() } else { self.blind_drift(&pose, timestamp_ns) };
        self.drift_at_keyframe = self.drift;
        self.forget_scale();
        self.motion.camera_from_world = *predicted;
        self.motion.timestamp_ns = timestamp_ns;
        self.n_doubtful = 0;
        FramePose {
            status: if is_first_ever { FrameStatus::Tracked } else { FrameStatus::Doubtful },
            reason: if is_first_ever { StatusReason::FirstFrame } else { StatusReason::Restarted },
            model: if is_first_ever { PoseModel::Origin } else { PoseModel::Predicted },
            is_keyframe: true,
            ..pose
        }
    }

    /// Gives the window up; the next frame opens a new one at the predicted pose.
    pub(super) fn abandon_window(&mut self) {
        self.window.clear(self.landmarks);
        self.tracks.clear();
        self.is_started = false;
        self.n_doubtful = 0;
        self.motion.prior = None;
        self.n_keyframe_points = 0;
        self.road = None;
        self.forget_scale();
    }
}
