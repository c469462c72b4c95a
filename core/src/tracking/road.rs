//! Metres from the road, at the start and ever after.

use super::RoadPlane;
use super::tracker::Tracker;
use crate::conventions::Rigid;
use crate::pose::RelativePose;
use crate::scale::{RoadAlignment, RoadPair, ScaleUpdate, align_road};
use nalgebra::{Translation3, Vector3};

/// Lengths of the first step that are searched, m.
const FIRST_STEP_RANGE_M: [f64; 2] = [0.1, 8.0];
/// How far a step's length may be off that the speed so far predicts, before there are landmarks.
const COASTED_RANGE: [f64; 2] = [0.5, 2.0];
/// Lengths that are tried around one that landmarks tell: how far the scale may drift unseen behind a truck.
const KNOWN_RANGE: [f64; 2] = [0.75, 1.33];

/// A measurement that keeps this much weight shows the road well enough to learn its normal from.
const BELIEVED_WEIGHT: f64 = 0.5;

/// A step's length as the road tells it.
pub(super) struct RoadStep {
    pub(super) step_m: f64,
    pub(super) n_pixels: usize,
}

/// What a keyframe learnt about the scale.
pub(super) struct ScaleFigures {
    /// Measured over predicted scale; NaN when it was not measured.
    pub(super) ratio: f64,
    pub(super) n_pixels: usize,
}

impl Tracker<'_> {
    /// Length of the step from the keyframe to the current frame, from the road alone.
    pub(super) fn road_step(&mut self, motion: &RelativePose, predicted_m: f64) -> Option<RoadStep> {
        let later_from_earlier =
            |length_m: f64| Rigid::from_parts(Translation3::from(motion.direction * length_m), motion.rotation);
        let pair = |length_m: f64| RoadPair {
            later: &self.pyramids[self.current_slot],
            earlier: &self.pyramids[self.keyframe_slot],
            camera: &self.camera,
            earlier_from_later: later_from_earlier(length_m).inverse(),
            expected_normal: self.expected_normal,
            expected_height_m: self.mounting.height_m,
        };
        let settings = &self.settings.road;
        let is_known = self.motion.prior.is_some() && predicted_m > 0.0;
        // A step of 1 m sees the road at 1 / length of its height.
        let [shortest_m, longest_m] = FIRST_STEP_RANGE_M;
        let (start_m, range) =
            if is_known { (predicted_m, COASTED_RANGE) } else { (1.0, [1.0 / longest_m, 1.0 / shortest_m]) };
        let found = align_road(&pair(start_m), range, &self.mounting, settings).ok()?;
        let step_m = start_m * self.mounting.height_m / found.height_m;
        Some(RoadStep { step_m, n_pixels: found.n_pixels })
    }

    /// Measures the road between the two newest keyframes, merges the scale and corrects the window.
    ///
    /// `earlier_slot` holds the pyramid of the keyframe before the newest, `current_slot` that of the newest.
    pub(super) fn correct_scale(&mut self, earlier_slot: usize) -> ScaleFigures {
        let nothing = ScaleFigures { ratio: f64::NAN, n_pixels: 0 };
        let mut newest_first = self.window.columns_by_age().collect::<heapless::Vec<_, 8>>();
        newest_first.reverse();
        let &[newest, earlier, ..] = newest_first.as_slice() else { return nothing };
        let (Some(later_k), Some(earlier_k)) = (self.window.at(newest), self.window.at(earlier)) else {
            return nothing;
        };
        let earlier_from_later = earlier_k.camera_from_world * later_k.camera_from_world.inverse();
        let step_m = earlier_from_later.translation.vector.norm();
        let turn_rad = earlier_from_later.rotation.angle();
        let drift = self.scale.drive(step_m, turn_rad, &self.settings.scale);
        self.drift_at_keyframe.drive(step_m);
        let pair = RoadPair {
            later: &self.pyramids[self.current_slot],
            earlier: &self.pyramids[earlier_slot],
            camera: &self.camera,
            earlier_from_later,
            expected_normal: self.expected_normal,
            expected_height_m: self.mounting.height_m,
        };
        let measured = align_road(&pair, KNOWN_RANGE, &self.mounting, &self.settings.road);
        self.window.rescale(drift, earlier, self.landmarks);
        let Ok(found) = measured else { return nothing };
        let ratio = self.mounting.height_m / found.height_m / drift;
        let update = self.scale.update(ratio, found.relative_sigma, &self.settings.scale);
        if let ScaleUpdate::Accept { correction, weight, gains } = update {
            self.drift_at_keyframe.correct_scale(gains);
            self.window.rescale(correction, earlier, self.landmarks);
            if weight > BELIEVED_WEIGHT {
                self.learn_normal(&found);
            }
        }
        ScaleFigures { ratio, n_pixels: found.n_pixels }
    }

    /// Lets the expected normal follow the measured ones slowly and not far from the mounting's.
    fn learn_normal(&mut self, found: &RoadAlignment) {
        self.road =
            Some(RoadPlane { normal_in_camera: found.normal_in_camera.into(), height_m: self.mounting.height_m });
        let share = self.settings.normal_adaptation;
        let next: Vector3<f64> = (self.expected_normal * (1.0 - share) + found.normal_in_camera * share).normalize();
        if next.angle(&self.mounting.road_normal_in_camera()) <= self.settings.max_normal_deviation_rad {
            self.expected_normal = next;
        }
    }
}
