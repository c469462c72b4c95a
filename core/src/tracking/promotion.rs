//! What happens when a frame becomes a keyframe.

use super::depths::{mark_impossible, triangulate_new};
use super::frame_pose::FramePose;
use super::matches::z1_of;
use super::tracker::{NO_LANDMARK, Tracker};
use super::{Aids, DynamicFilter, KeyframePoint, PoseModel, Travelled};
use crate::bundle::{BundleSettings, adjust};
use crate::conventions::TimestampNs;
use crate::keyframe::Column;

/// Width of Huber's kernel in the bundle adjustment, standard deviations (95 % efficiency).
const HUBER_SIGMAS: f64 = 1.345;

impl Tracker<'_> {
    /// Makes the current frame the newest keyframe; `pose` becomes the adjusted one.
    pub(super) fn promote(
        &mut self,
        frame_index: u64,
        timestamp_ns: TimestampNs,
        pose: &mut FramePose,
        aids: &mut Aids<'_>,
    ) {
        let earlier_slot = self.keyframe_slot;
        self.mark_contradicted(pose);
        let column = self.window.push(frame_index, timestamp_ns, pose.camera_from_world, self.landmarks);
        self.link_landmarks();
        self.record_sightings(column);
        triangulate_new(&self.window, self.landmarks, &self.camera, &self.settings);
        // A turn shows no depth, whatever the noise says.
        if self.settings.bundle_adjustment && pose.model != PoseModel::Rotation {
            let settings = BundleSettings {
                noise_z1: self.settings.noise_z1(&self.camera),
                huber_sigmas: HUBER_SIGMAS,
                outlier_sigmas: self.settings.outlier_sigmas,
                max_iterations: self.settings.bundle_iterations,
                min_sightings: self.witness_sightings(),
            };
            adjust(&mut self.window, self.landmarks, pose.prior.as_ref(), self.bundle, &settings);
        }
        if self.is_started {
            let scale = self.correct_scale(earlier_slot, aids);
            (pose.scale_ratio, pose.n_road, pose.scale_sources) = (scale.ratio, scale.n_pixels, scale.sources);
        }
        if self.settings.dynamic_filter == DynamicFilter::Region {
            let (normal, height_m) = (self.expected_normal, self.mounting.height_m);
            let share = self.settings.below_road_ratio;
            pose.n_dynamic += mark_impossible(&self.window, self.landmarks, &normal, height_m, share);
        }
        self.mark_company_of_outliers();
        self.drop_outliers();
        let was_started = self.is_started;
        self.judge_start();
        self.keyframe_slot = self.current_slot;
        self.tracks.promote(self.simd, &self.pyramids[self.current_slot], &self.settings.tracks);
        self.link_landmarks();
        self.adopt_new_tracks(column);
        if self.is_started && !was_started {
            self.note_newest();
            self.publish_points();
            pose.scale_sources = pose.scale_sources.and(self.correct_first_scale(aids));
        }
        self.travelled = Some(Travelled::NOTHING);
        if let Some(adjusted) = self.window.newest() {
            pose.camera_from_world = adjusted.camera_from_world;
        }
        self.note_drift(pose);
        self.drift_at_keyframe = self.drift;
        self.note_newest();
        self.publish_points();
        pose.is_keyframe = true;
    }

    /// Whether enough landmarks with a depth are in view to go on from. A turn on the spot leaves them behind and finds no
    /// others: then the length of the next step is as unknown as at the beginning.
    fn judge_start(&mut self) {
        let n_depths = self.landmarks.iter().filter(|l| l.is_tracked && l.has_depth() && !l.is_outlier).count();
        let was_started = core::mem::replace(&mut self.is_started, n_depths >= self.settings.min_inliers);
        if was_started && !self.is_started {
            self.forget_scale();
        }
    }

    /// The newest keyframe's view of the landmarks whose tracks are alive.
    fn record_sightings(&mut self, column: Column) {
        for (track, &idx) in self.tracks.tracks().iter().zip(self.scratch.landmark_of_track.iter()) {
            if let Some(landmark) = self.landmarks.get_mut(idx as usize) {
                landmark.record(column, &z1_of(&self.camera, track.current_px));
            }
        }
    }

    /// Ends the tracks of outliers, so that new corners can be found in their place, and frees what nobody needs.
    fn drop_outliers(&mut self) {
        let (landmarks, linked) = (&mut *self.landmarks, &*self.scratch.landmark_of_track);
        let mut place = 0;
        self.tracks.retain(|_| {
            let landmark = linked.get(place).and_then(|&idx| landmarks.get(idx as usize));
            place += 1;
            landmark.is_none_or(|l| !l.is_outlier)
        });
        for landmark in landmarks.iter_mut() {
            if landmark.is_outlier || (!landmark.is_tracked && !landmark.has_depth()) {
                landmark.clear();
            }
        }
    }

    /// Gives every track without a landmark one, hosted by the keyframe in `column`; a full pool refuses.
    pub(super) fn adopt_new_tracks(&mut self, column: Column) {
        self.link_landmarks();
        let mut next_free = 0;
        for (track, idx) in self.tracks.tracks().iter().zip(self.scratch.landmark_of_track.iter_mut()) {
            if *idx != NO_LANDMARK {
                continue;
            }
            let Some(offset) = self.landmarks.iter().skip(next_free).position(|l| !l.is_used()) else { break };
            let free = next_free + offset;
            next_free = free + 1;
            if let Some(landmark) = self.landmarks.get_mut(free) {
                landmark.clear();
                (landmark.track_id, landmark.is_tracked) = (track.id, true);
                landmark.record(column, &z1_of(&self.camera, track.keyframe_px));
                *idx = free as u32;
            }
        }
    }

    /// Publishes the landmarks that the newest keyframe sees.
    fn publish_points(&mut self) {
        let camera_from_world = self.newest.camera_from_world;
        let mut n = 0;
        for (track, &idx) in self.tracks.tracks().iter().zip(self.scratch.landmark_of_track.iter()) {
            let Some(landmark) = self.landmarks.get(idx as usize).filter(|l| l.has_depth()) else { continue };
            let Some(view) = self.window.landmark_in(landmark, &camera_from_world) else { continue };
            if view.inverse_depth <= 0.0 {
                continue;
            }
            let Some(slot) = self.keyframe_points.get_mut(n) else { break };
            *slot = KeyframePoint {
                pixel: track.keyframe_px,
                depth_m: (1.0 / view.inverse_depth) as f32,
                relative_sigma: (view.sigma / view.inverse_depth) as f32,
            };
            n += 1;
        }
        self.n_keyframe_points = n;
    }
}
