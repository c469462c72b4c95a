//! The pose of one frame against the last keyframe.

use super::drift::{CLAIM_FACTOR, coasting_information, step_covariance};
use super::epipolar::ModelChoice;
use super::matches::z1_of;
use super::recovery::{Aids, MatchSource};
use super::settings::PoseModels;
use super::tracker::{Motion, Tracker, seconds_between};
use super::{FrameStatus, PoseModel, StatusReason};
use crate::bundle::PosePrior;
use crate::camera::Mounting;
use crate::conventions::{Rigid, TimestampNs};
use crate::features::tracks::TrackReport;
use crate::math::{Rng, se3};
use crate::pose::{LandmarkMatch, PoseRefinement, estimate_pnp, fit_turn};
use crate::scale::ScaleSources;
use crate::verify::{MotionVerdict, judge_motion};
use nalgebra::{Matrix6, Translation3, UnitQuaternion, Vector3};

/// Random streams of the robust loops.
const PURPOSE_PNP: u64 = 1;
/// Tracks of the road that must stand still for the vehicle to stand, and their share.
const MIN_STANDING_TRACKS: usize = 12;
const STANDING_SHARE: f64 = 0.6;
/// Fewest landmarks that make a pose where the motion so far holds it.
const FEWEST_STEADIED: usize = 8;
/// Squared standard deviations by which such a pose may differ from what the motion so far says: the chi-square
/// distribution of six numbers goes beyond that once in a thousand times.
const MOST_OFF_SIGMAS2: f64 = 22.5;
/// Rays this steep below the horizon see the street nearer than about 30 m: sine of the angle.
const MIN_ROAD_SINE: f64 = 0.05;

/// The frame whose pose is wanted.
pub(super) struct Moment {
    /// `camera_from_world` by constant velocity.
    pub(super) predicted: Rigid,
    pub(super) frame_index: u64,
    pub(super) timestamp_ns: TimestampNs,
}

/// What became of a frame's pose.
#[derive(Clone, Copy, Debug)]
pub(super) struct FramePose {
    pub(super) status: FrameStatus,
    pub(super) reason: StatusReason,
    pub(super) model: PoseModel,
    /// Where the matches behind it came from.
    pub(super) source: MatchSource,
    pub(super) camera_from_world: Rigid,
    pub(super) is_keyframe: bool,
    pub(super) is_standing: bool,
    /// Whether the length of the step was measured or predicted from measured ones.
    pub(super) is_metric: bool,
    /// Which model the matches called for, where both were tried.
    pub(super) choice: Option<ModelChoice>,
    /// What the motion so far says, where the image says little.
    pub(super) prior: Option<PosePrior>,
    /// Covariance of the left increment against the last keyframe (rad, m); nothing for the length's scale.
    pub(super) step_covariance: Matrix6<f64>,
    pub(super) n_matches: usize,
    pub(super) n_inliers: usize,
    pub(super) n_dynamic: usize,
    pub(super) turn_change_rad: f64,
    pub(super) side_slip_rad: f64,
    pub(super) scale_ratio: f64,
    pub(super) n_road: usize,
    /// Whose measurements of the scale were merged.
    pub(super) scale_sources: ScaleSources,
}

impl FramePose {
    /// The motion model's prediction.
    pub(super) fn predicted(camera_from_world: &Rigid) -> Self {
        Self {
            status: FrameStatus::Doubtful,
            reason: StatusReason::TooFewInliers,
            model: PoseModel::Predicted,
            source: MatchSource::Tracks,
            camera_from_world: *camera_from_world,
            is_keyframe: false,
            is_standing: false,
            is_metric: false,
            choice: None,
            prior: None,
            step_covariance: Matrix6::zeros(),
            n_matches: 0,
            n_inliers: 0,
            n_dynamic: 0,
            turn_change_rad: 0.0,
            side_slip_rad: f64::NAN,
            scale_ratio: f64::NAN,
            n_road: 0,
            scale_sources: ScaleSources::NONE,
        }
    }

    /// No pose; the last one stands in for it.
    pub(super) fn lost(motion: &Motion, reason: StatusReason) -> Self {
        Self { status: FrameStatus::Lost, reason, ..Self::predicted(&motion.camera_from_world) }
    }

    pub(super) fn solved(camera_from_world: &Rigid, model: PoseModel, n_matches: usize, n_inliers: usize) -> Self {
        Self {
            status: FrameStatus::Tracked,
            reason: StatusReason::Verified,
            model,
            n_matches,
            n_inliers,
            is_metric: true,
            ..Self::predicted(camera_from_world)
        }
    }

    /// Length of the axle's step, m.
    pub(super) fn step_m(&self, mounting: &Mounting, later_from_earlier: &Rigid) -> f32 {
        let lever = Vector3::from(mounting.lever_arm_m);
        let moved = later_from_earlier.rotation.inverse() * (lever - later_from_earlier.translation.vector);
        (moved - lever).norm() as f32
    }

    fn of_source(self, source: MatchSource) -> Self {
        // A mere turn stays one: no depth may be learnt from it, however it was seen.
        let is_dense = source == MatchSource::Dense && self.model != PoseModel::Rotation;
        let model = if is_dense { PoseModel::Dense } else { self.model };
        Self { model, source, ..self }
    }

    fn with_figures(self, verdict: &MotionVerdict) -> Self {
        let reason = match verdict {
            MotionVerdict::Accept(_) => self.reason,
            MotionVerdict::TurnsTooFast(_) => StatusReason::TurnsTooFast,
            MotionVerdict::SlipsSideways(_) => StatusReason::SlipsSideways,
            MotionVerdict::TooFast(_) => StatusReason::TooFast,
        };
        let figures = verdict.figures();
        Self { reason, turn_change_rad: figures.turn_change_rad, side_slip_rad: figures.side_slip_rad, ..self }
    }
}

impl Tracker<'_> {
    /// Finds, checks and, if need be, replaces the pose of the current frame.
    pub(super) fn frame_pose(&mut self, moment: &Moment, tracks: &mut TrackReport, aids: &mut Aids<'_>) -> FramePose {
        let has_tracks = self.tracks.tracks().len() >= self.settings.min_inliers;
        if !has_tracks && !aids.can_match() {
            let reason = StatusReason::TooFewMatches;
            return FramePose { status: FrameStatus::Lost, reason, ..FramePose::predicted(&moment.predicted) };
        }
        let is_still = f64::from(tracks.median_flow_px) < self.settings.standing_flow_px
            || self.street_only_turns(&UnitQuaternion::identity());
        if has_tracks
            && is_still
            && let (standing, true) = self.verified(self.standing(), moment.timestamp_ns)
        {
            return standing;
        }
        if has_tracks
            && let Some((turned, true)) = self.turned_on_the_spot(moment).map(|p| self.verified(p, moment.timestamp_ns))
        {
            return turned;
        }
        let (mut weak, mut refused): (Option<FramePose>, _) = (None, None);
        for source in [MatchSource::Tracks, MatchSource::Sparse, MatchSource::Dense] {
            if source != MatchSource::Tracks && !self.rematch(source, aids, tracks) {
                continue;
            }
            match self.solve(moment, source) {
                Some((pose, true)) if pose.n_inliers >= self.settings.enough_inliers => return pose,
                Some((pose, true)) => weak = weak.filter(|w| w.n_inliers >= pose.n_inliers).or(Some(pose)),
                Some((pose, false)) => refused = refused.or(Some(pose)),
                None => {}
            }
        }
        if let Some(pose) = weak {
            return pose;
        }
        let reason = if has_tracks { StatusReason::TooFewInliers } else { StatusReason::TooFewMatches };
        let figures = refused.unwrap_or(FramePose { reason, ..FramePose::predicted(&moment.predicted) });
        FramePose {
            status: FrameStatus::Doubtful,
            model: PoseModel::Predicted,
            camera_from_world: moment.predicted,
            ..figures
        }
    }

    /// A pose from the live tracks, and whether it is believed; the first refused one when none is.
    fn solve(&mut self, moment: &Moment, source: MatchSource) -> Option<(FramePose, bool)> {
        if self.tracks.tracks().len() < self.settings.min_inliers {
            return None;
        }
        let noise_px = self.settings.noise_px_of(source);
        let models = self.settings.pose_models;
        let by_landmarks = (self.is_started && models != PoseModels::Essential)
            .then(|| self.pnp_pose(moment, noise_px))
            .flatten()
            .map(|pose| self.verified(pose.of_source(source), moment.timestamp_ns));
        if matches!(by_landmarks, Some((_, true))) {
            return by_landmarks;
        }
        let by_epipolar_lines = (!self.is_started || models != PoseModels::Pnp)
            .then(|| self.essential_pose(moment, noise_px))
            .flatten()
            .map(|pose| self.verified(pose.of_source(source), moment.timestamp_ns));
        by_epipolar_lines.filter(|(_, is_believed)| *is_believed).or(by_landmarks).or(by_epipolar_lines)
    }

    /// Judges the step from the last frame: the pose with the verdict's figures, and whether it is believed.
    fn verified(&self, pose: FramePose, timestamp_ns: TimestampNs) -> (FramePose, bool) {
        let (earlier_from_world, duration_s) = if self.is_started {
            (self.motion.camera_from_world, self.seconds_since_last(timestamp_ns))
        } else {
            (self.newest.camera_from_world, seconds_between(self.newest.timestamp_ns, timestamp_ns))
        };
        let later_from_earlier = pose.camera_from_world * earlier_from_world.inverse();
        let prior = self.motion.prior.as_ref();
        let limits = &self.settings.motion;
        let verdict = judge_motion(&later_from_earlier, duration_s, prior, &self.mounting, limits);
        let pose = pose.with_figures(&verdict);
        let is_finite = pose.camera_from_world.to_homogeneous().iter().all(|v| v.is_finite());
        (pose, verdict.is_accepted() && is_finite)
    }

    /// The same pose as the keyframe's: nothing of the street has moved since.
    fn standing(&self) -> FramePose {
        let n = self.tracks.tracks().len();
        let model = if self.is_started { PoseModel::Pnp } else { PoseModel::Essential };
        let step_covariance = self.standing_covariance();
        FramePose {
            is_standing: true,
            step_covariance,
            ..FramePose::solved(&self.newest.camera_from_world, model, n, n)
        }
    }

    /// The keyframe's place in another direction, where the street shows no more than that.
    ///
    /// Landmarks cannot tell: those that come into view during a turn have no depth, and whatever they are given the pose
    /// would follow.
    fn turned_on_the_spot(&mut self, moment: &Moment) -> Option<FramePose> {
        let n = self.collect_matches();
        let keyframe_from_world = self.newest.camera_from_world;
        let guess = (moment.predicted * keyframe_from_world.inverse()).rotation;
        let rotation = fit_turn(self.scratch.matches.get(..n)?, &guess, self.settings.noise_z1(&self.camera))?;
        let camera_from_world = Rigid::from_parts(Translation3::identity(), rotation) * keyframe_from_world;
        self.street_only_turns(&rotation).then(|| FramePose {
            step_covariance: self.standing_covariance(),
            ..FramePose::solved(&camera_from_world, PoseModel::Rotation, n, n)
        })
    }

    /// Whether most points on and beside the road, where any motion must show, have moved since the keyframe no further
    /// than this rotation moves them.
    ///
    /// Traffic around a standing vehicle can make up most of the flow, and any essential matrix without rotation
    /// explains a point that stands still; but a street nearer than 30 m cannot stand still under a moving camera.
    fn street_only_turns(&self, rotation: &UnitQuaternion<f64>) -> bool {
        let limit_z1 = self.settings.standing_flow_px / self.camera.fx;
        let (mut n_street, mut n_still) = (0, 0);
        for track in self.tracks.tracks() {
            let z1 = z1_of(&self.camera, track.keyframe_px);
            let ray = Vector3::new(z1.x, z1.y, 1.0);
            if ray.normalize().dot(&self.expected_normal) > MIN_ROAD_SINE {
                let turned = rotation * ray;
                let off_z1 = (z1_of(&self.camera, track.current_px) - turned.xy() / turned.z).norm();
                n_street += 1;
                n_still += usize::from(off_z1 < limit_z1);
            }
        }
        n_street >= MIN_STANDING_TRACKS && n_still as f64 > STANDING_SHARE * n_street as f64
    }

    /// Pose from the window's landmarks: the tested ones decide.
    fn pnp_pose(&mut self, moment: &Moment, noise_px: f64) -> Option<FramePose> {
        let n = self.collect_landmark_matches();
        let keyframe_from_world = self.newest.camera_from_world;
        let settings = self.settings.pnp(&self.camera, noise_px);
        let mut rng = Rng::new(self.seed, moment.frame_index, PURPOSE_PNP);
        let guess = moment.predicted * keyframe_from_world.inverse();
        let n_witnesses = self.witnesses_to_the_front(n);
        let witnesses = self.scratch.landmark_matches.get(..n_witnesses)?;
        let found = estimate_pnp(witnesses, &guess, &settings, &mut rng, self.scratch.is_inlier).ok()?;
        let n_agreeing = self.scratch.is_inlier.iter().take(n_witnesses).filter(|&&i| i).count();
        let is_weak = n_agreeing < self.settings.enough_inliers && self.motion.prior.is_some();
        let fewest = if is_weak { FEWEST_STEADIED } else { self.settings.min_inliers };
        if n_agreeing < fewest || (n_agreeing as f64) < self.settings.min_inlier_ratio * n_witnesses as f64 {
            return None;
        }
        let PoseRefinement { camera_from_reference, information, .. } = found.refined;
        let limit2 = settings.inlier_sigmas * settings.inlier_sigmas;
        let agrees = |m: &&LandmarkMatch| m.squared_sigmas(&camera_from_reference, settings.noise_z1) < limit2;
        let n_inliers = self.scratch.landmark_matches.iter().take(n).filter(agrees).count();
        let camera_from_world = camera_from_reference * keyframe_from_world;
        let solved = FramePose::solved(&camera_from_world, PoseModel::Pnp, n, n_inliers);
        let n_dynamic = n - n_inliers;
        let solved = FramePose { n_dynamic, step_covariance: step_covariance(&information), ..solved };
        if is_weak { self.steadied(solved, &information, moment) } else { Some(solved) }
    }

    /// A pose from few matches, held by what the motion so far says: the mean of both, each by its information; `None` where
    /// they contradict each other.
    fn steadied(&self, pose: FramePose, information: &Matrix6<f64>, moment: &Moment) -> Option<FramePose> {
        let expected = coasting_information(self.seconds_since_last(moment.timestamp_ns));
        let prior = PosePrior { camera_from_world: moment.predicted, information: expected };
        let off = se3::log(&(moment.predicted * pose.camera_from_world.inverse()));
        let both = (information / CLAIM_FACTOR + expected).cholesky()?;
        let step = both.solve(&(expected * off));
        // (A^-1 + B^-1)^-1 = B - B (A + B)^-1 B, the information of the difference.
        if off.dot(&(expected * (off - step))) > MOST_OFF_SIGMAS2 {
            return None;
        }
        let camera_from_world = se3::exp(&step) * pose.camera_from_world;
        Some(FramePose { camera_from_world, prior: Some(prior), ..pose })
    }
}
