//! Poses that are given instead of tracked: everything but the mapper is taken out of a comparison.

use crate::pose_file::PoseFile;
use kilogs_camera::source::Schedule;
use kilogs_core::conventions::Rigid;
use kilogs_core::tracking::{FrameReport, FrameStatus, PoseModel, StatusReason};
use kilogs_eval::command::EvalError;
use nalgebra::Matrix6;
use std::path::PathBuf;

/// Below this the tracker's own step tells nothing about its scale, m.
const MIN_STEP_M: f64 = 0.1;

/// Standard deviation of a given pose, rad and m: taken as exact, but a covariance has to have an inverse.
const GIVEN_SIGMA: f64 = 1e-6;

/// Which line of which file is the pose of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct GivenPosesPlan {
    /// A file in KITTI's format.
    pub file: PathBuf,
    /// The image that each frame of the stream shows.
    pub schedule: Schedule,
    /// Line of the pose of the recording's first image, counted from 0.
    pub first_line: u64,
}

/// Puts given poses into the tracker's reports. Which frames become keyframes is still the tracker's choice.
#[derive(Debug)]
pub struct GivenPoses {
    file: PoseFile,
    plan: GivenPosesPlan,
    first_from_world: Rigid,
    newest: Option<Keyframe>,
    points_scale: Option<f32>,
}

#[derive(Debug, Clone, Copy)]
struct Keyframe {
    ordinal: u32,
    world_from_camera: Rigid,
    tracked_world_from_camera: Rigid,
}

impl GivenPoses {
    /// Opens the file; the first frame of the stream is the origin.
    ///
    /// # Errors
    /// [`EvalError`] naming the file and the line that is wrong.
    pub fn open(plan: &GivenPosesPlan) -> Result<Self, EvalError> {
        let mut file = PoseFile::open(&plan.file)?;
        let first = file.pose(plan.line_of_frame(0))?.unwrap_or_else(Rigid::identity);
        Ok(Self { file, plan: plan.clone(), first_from_world: first.inverse(), newest: None, points_scale: None })
    }

    /// Replaces what the tracker found by what is known; a frame beyond the last pose is lost.
    pub fn replace(&mut self, report: &mut FrameReport) {
        let is_in_stream = report.frame_index < self.plan.schedule.n_steps();
        let line = self.plan.line_of_frame(report.frame_index);
        let given = if is_in_stream { self.file.pose(line) } else { Ok(None) };
        let given = given.unwrap_or_else(|problem| {
            log::error!("no pose for frame {}: {problem}", report.frame_index);
            None
        });
        let Some(world_from_camera) = given.map(|pose| self.first_from_world * pose) else {
            (report.status, report.reason, report.is_keyframe) = (FrameStatus::Lost, StatusReason::Unusable, false);
            return;
        };
        if report.is_keyframe || self.newest.is_none() {
            let keyframe = Keyframe {
                ordinal: report.keyframe_ordinal,
                world_from_camera,
                tracked_world_from_camera: report.world_from_camera,
            };
            self.points_scale = self.newest.and_then(|before| scale_of_step(&before, &keyframe));
            self.newest = Some(keyframe);
        }
        let Some(newest) = self.newest else { return };
        (report.status, report.reason, report.model) =
            (FrameStatus::Tracked, StatusReason::Verified, PoseModel::Origin);
        report.keyframe_ordinal = newest.ordinal;
        report.keyframe_from_camera = newest.world_from_camera.inverse() * world_from_camera;
        report.world_from_camera = world_from_camera;
        report.covariance = Matrix6::identity() * (GIVEN_SIGMA * GIVEN_SIGMA);
    }

    /// Factor that brings the tracker's depths at the newest keyframe to the scale of the given poses, where it can be
    /// told.
    pub fn points_scale(&self) -> Option<f32> {
        self.points_scale
    }
}

impl GivenPosesPlan {
    fn line_of_frame(&self, frame_index: u64) -> u64 {
        self.first_line + self.schedule.frame_index(frame_index)
    }
}

fn scale_of_step(before: &Keyframe, now: &Keyframe) -> Option<f32> {
    let step_m = |from: &Rigid, to: &Rigid| (to.translation.vector - from.translation.vector).norm();
    let tracked_m = step_m(&before.tracked_world_from_camera, &now.tracked_world_from_camera);
    let given_m = step_m(&before.world_from_camera, &now.world_from_camera);
    (tracked_m > MIN_STEP_M && given_m > MIN_STEP_M).then_some((given_m / tracked_m) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use kilogs_camera::source::PlaybackRange;
    use nalgebra::Vector3;

    fn tracked(frame_index: u64, keyframe_ordinal: u32, is_keyframe: bool, z_m: f64) -> FrameReport {
        FrameReport {
            frame_index,
            timestamp_ns: frame_index,
            status: FrameStatus::Doubtful,
            reason: StatusReason::TooFast,
            model: PoseModel::Predicted,
            source: kilogs_core::tracking::MatchSource::Tracks,
            is_keyframe,
            keyframe_ordinal,
            keyframe_from_camera: Rigid::identity(),
            world_from_camera: Rigid::translation(0.0, 0.0, z_m),
            covariance: Matrix6::identity(),
            n_tracks: 0,
            n_matches: 0,
            n_inliers: 0,
            n_dynamic: 0,
            median_flow_px: 0.0,
            gric: [f32::NAN; 2],
            rotation_anomaly_rad: 0.0,
            direction_anomaly_rad: 0.0,
            step_m: 0.0,
            scale_ratio: 0.0,
            scale_sigma: 0.0,
            scale_sources: kilogs_core::scale::ScaleSources::NONE,
            n_road: 0,
        }
    }

    #[test]
    fn given_poses_begin_at_the_origin_and_scale_the_depths() {
        let folder = tempfile::tempdir().expect("a folder");
        let file = folder.path().join("poses.txt");
        // The recording's first image is line 1; the stream begins with its second.
        let lines = (0..6).map(|k| format!("1 0 0 7 0 1 0 0 0 0 1 {}\n", 2 * k));
        std::fs::write(&file, lines.collect::<String>()).expect("a file");
        let range = PlaybackRange { start: 1, frames: Some(4), passes: 1 };
        let schedule = Schedule::new(5, &range).expect("a part of it");
        let mut given = GivenPoses::open(&GivenPosesPlan { file, schedule, first_line: 1 }).expect("a pose file");
        let mut check = |mut report: FrameReport, z_m: f64, relative_z_m: f64, scale: Option<f32>| {
            given.replace(&mut report);
            assert_eq!(report.status, FrameStatus::Tracked);
            assert_eq!(report.world_from_camera.translation.vector, Vector3::new(0.0, 0.0, z_m));
            assert!((report.keyframe_from_camera.translation.z - relative_z_m).abs() < 1e-12);
            assert_eq!(given.points_scale(), scale);
        };
        check(tracked(0, 0, true, 0.0), 0.0, 0.0, None);
        check(tracked(1, 0, false, 1.0), 2.0, 2.0, None);
        check(tracked(2, 1, true, 2.0), 4.0, 0.0, Some(2.0));
        check(tracked(3, 2, true, 2.0), 6.0, 0.0, None);
        let mut beyond = tracked(4, 2, true, 3.0);
        given.replace(&mut beyond);
        assert!(beyond.status == FrameStatus::Lost && !beyond.is_keyframe);
    }
}
