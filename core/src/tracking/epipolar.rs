//! Pose from epipolar lines alone, where they fix a direction of motion.

use super::PoseModel;
use super::drift::step_covariance;
use super::frame_pose::{FramePose, Moment};
use super::tracker::Tracker;
use crate::conventions::Rigid;
use crate::math::Rng;
use crate::pose::{
    Match, RelativePose, RelativeSettings, StepLength, estimate_homography, estimate_relative, fit_step_length,
    gric_essential, gric_homography, relative_covariance, rotation_of_homography,
};
use crate::scale::{ScaleSource, ScaleSources};
use nalgebra::{Matrix3, Matrix6, Translation3};

/// Random streams of the robust loops.
const PURPOSE_ESSENTIAL: u64 = 2;
const PURPOSE_HOMOGRAPHY: u64 = 3;
/// A step shorter than this has no direction, m.
const SHORTEST_STEP_M: f64 = 1e-6;
/// How far the speed so far tells the length of a step before there are landmarks, relative.
const COASTED_LENGTH_RATIO: f64 = 0.3;
/// A homography this near to a rotation is one, standard deviations of a match. Ours: with some hundred matches its
/// entries are known to a fraction of one.
const MOST_OFF_SIGMAS: f64 = 3.0;

/// Which model the matches call for: the lower the figure, the better.
#[derive(Clone, Copy, Debug)]
pub(super) struct ModelChoice {
    pub(super) gric_essential: f64,
    pub(super) gric_homography: f64,
    homography: Matrix3<f64>,
}

impl ModelChoice {
    /// A plane or a mere turn explains everything: the essential matrix has no direction to tell.
    fn is_degenerate(&self) -> bool {
        self.gric_homography <= self.gric_essential
    }
}

impl Tracker<'_> {
    /// Pose from the essential matrix of all tracks since the keyframe, with the best length of the step there is.
    ///
    /// Where a homography explains the matches as well, there is no such pose; before there are landmarks a mere turn
    /// is one all the same.
    pub(super) fn essential_pose(&mut self, moment: &Moment, noise_px: f64) -> Option<FramePose> {
        let n = self.collect_matches();
        let matches = self.scratch.matches.get(..n)?;
        let keyframe_from_world = self.newest.camera_from_world;
        let guess = moment.predicted * keyframe_from_world.inverse();
        let length_m = guess.translation.vector.norm();
        let predicted_direction = (length_m > SHORTEST_STEP_M)
            .then(|| RelativePose { rotation: guess.rotation, direction: guess.translation.vector / length_m });
        let settings = self.settings.relative(&self.camera, noise_px);
        let mut rng = Rng::new(self.seed, moment.frame_index, PURPOSE_ESSENTIAL);
        let found =
            estimate_relative(matches, predicted_direction.as_ref(), &settings, &mut rng, self.scratch.is_inlier)
                .ok()?;
        let needed = self.settings.min_inliers.max((self.settings.min_inlier_ratio * n as f64) as usize);
        let in_front = self.settings.min_in_front_ratio * found.n_inliers as f64;
        let motion = found.second_from_first;
        let choice = self.choose_model(&motion, n, &settings, moment);
        let mut pose = FramePose {
            n_dynamic: n - found.n_inliers,
            choice,
            ..FramePose::solved(&keyframe_from_world, PoseModel::Essential, n, found.n_inliers)
        };
        if let Some(choice) = choice.filter(ModelChoice::is_degenerate) {
            return self.turn(&choice, needed, pose);
        }
        if found.n_inliers < needed || (found.n_in_front as f64) < in_front {
            return None;
        }
        let StepLength { length_m, sigma_m } = self.length_of_step(&motion, length_m, &mut pose)?;
        let camera_from_keyframe = Rigid::from_parts(Translation3::from(motion.direction * length_m), motion.rotation);
        let (noise_z1, cutoff_z1) = (noise_px / self.camera.fx, settings.inlier_z1);
        let matches = self.scratch.matches.get(..n)?;
        pose.step_covariance = relative_covariance(matches, &motion, noise_z1, cutoff_z1, length_m, sigma_m)
            .unwrap_or_else(|| step_covariance(&Matrix6::zeros()));
        pose.camera_from_world = camera_from_keyframe * keyframe_from_world;
        Some(pose)
    }

    /// Compares both models on the matches that either explains; sorts those to the front.
    fn choose_model(
        &mut self,
        motion: &RelativePose,
        n: usize,
        settings: &RelativeSettings,
        moment: &Moment,
    ) -> Option<ModelChoice> {
        let (matches, is_inlier) = (self.scratch.matches.get_mut(..n)?, self.scratch.is_inlier.get_mut(..n)?);
        let n_of_motion = to_the_front(matches, is_inlier, 0);
        let mut rng = Rng::new(self.seed, moment.frame_index, PURPOSE_HOMOGRAPHY);
        let found = estimate_homography(matches, settings, &mut rng, is_inlier).ok()?;
        let n_of_either = to_the_front(matches, is_inlier, n_of_motion);
        let explained = matches.get(..n_of_either)?;
        let sigma_z1 = self.settings.gric_sigma_px / self.camera.fx;
        Some(ModelChoice {
            gric_essential: gric_essential(motion, explained, sigma_z1),
            gric_homography: gric_homography(&found.second_from_first, explained, sigma_z1),
            homography: found.second_from_first,
        })
    }

    /// The pose of a camera that only turned since the keyframe; for a start without landmarks.
    fn turn(&self, choice: &ModelChoice, needed: usize, pose: FramePose) -> Option<FramePose> {
        let (rotation, off) = rotation_of_homography(&choice.homography)?;
        let sigma_z1 = self.settings.gric_sigma_px / self.camera.fx;
        if self.is_started || pose.n_inliers < needed || off > MOST_OFF_SIGMAS * sigma_z1 {
            return None;
        }
        let camera_from_keyframe = Rigid::from_parts(Translation3::identity(), rotation);
        let camera_from_world = camera_from_keyframe * pose.camera_from_world;
        let step_covariance = self.standing_covariance();
        Some(FramePose { camera_from_world, model: PoseModel::Rotation, step_covariance, ..pose })
    }

    /// Metres of the step since the keyframe: from landmarks, else from the wheels, else from the road, else from the speed
    /// so far.
    fn length_of_step(&mut self, motion: &RelativePose, predicted_m: f64, pose: &mut FramePose) -> Option<StepLength> {
        let n = if self.is_started { self.collect_landmark_matches() } else { 0 };
        if n >= self.settings.min_inliers {
            let matches = self.scratch.landmark_matches.get(..n)?;
            return fit_step_length(matches, motion, predicted_m, self.settings.noise_z1(&self.camera));
        }
        if let Some(rolled) = self.wheel_step(motion) {
            (pose.is_metric, pose.scale_sources) = (true, ScaleSources::of(&[ScaleSource::WheelSpeed]));
            return Some(rolled);
        }
        if let Some(measured) = self.road_step(motion, predicted_m) {
            pose.n_road = measured.n_pixels;
            (pose.is_metric, pose.scale_sources) = (true, ScaleSources::of(&[ScaleSource::GroundPlane]));
            // Its error is that of the scale.
            return Some(StepLength { length_m: measured.step_m, sigma_m: 0.0 });
        }
        pose.is_metric = false;
        let sigma_m = COASTED_LENGTH_RATIO * predicted_m;
        self.motion.is_known().then_some(StepLength { length_m: predicted_m, sigma_m })
    }
}

/// Swaps the inliers from `first` on to the front; where they end.
fn to_the_front(matches: &mut [Match], is_inlier: &mut [bool], first: usize) -> usize {
    let mut n = first;
    for i in first..matches.len().min(is_inlier.len()) {
        if is_inlier[i] {
            matches.swap(n, i);
            is_inlier.swap(n, i);
            n += 1;
        }
    }
    n
}
