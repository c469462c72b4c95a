//! One frame through all tracking stages: the calculator's front door for the pipeline.

mod depths;
mod drift;
mod epipolar;
mod frame_pose;
mod matches;
mod promotion;
mod recovery;
mod restart;
mod road;
mod settings;
mod storage;
mod tracker;
mod witnesses;

pub use recovery::{Aids, MatchSource, Travelled};
pub use settings::{DynamicFilter, PoseModels, TrackingSettings};
pub use storage::{
    BYTES_PER_LANDMARK, BYTES_PER_TRACK, N_PYRAMIDS, TrackerCapacities, TrackerFill, TrackerStorage,
    TrackerStorageProblem,
};
pub use tracker::{PYRAMID_LEVELS, Tracker};

use crate::conventions::{Rigid, TimestampNs};
use crate::scale::ScaleSources;
use nalgebra::Matrix6;

/// What became of a frame. Frames that never reached the tracker (`dropped`) are counted by the pipeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameStatus {
    /// The pose was estimated and verified.
    Tracked,
    /// The pose is the motion model's prediction; the map must not learn from it.
    Doubtful,
    /// No pose that could be believed.
    Lost,
}

/// Why a frame has the status that it has; the numbers that decided stand beside it in the report.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StatusReason {
    /// The pose explains the image and the motion is one that a vehicle can make.
    Verified,
    /// The first frame, which defines the world.
    FirstFrame,
    /// The same bytes as the frame before, in the middle of a drive: the camera delivers, but it does not look.
    Frozen,
    /// Too few matches to estimate a motion from.
    TooFewMatches,
    /// No pose with which the matches agree.
    TooFewInliers,
    /// Turns by too much since the last step.
    TurnsTooFast,
    /// Slips sideways, or drives backwards where it may not.
    SlipsSideways,
    /// Too fast, or changes its speed too suddenly.
    TooFast,
    /// The window was given up and opens anew here; what happened in between is predicted.
    Restarted,
    /// The image has another size than the camera, or is not later than the one before.
    Unusable,
}

/// What the pose was estimated with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseModel {
    /// The first frame, which defines the world.
    Origin,
    /// Essential matrix with recovered scale.
    Essential,
    /// A mere turn, before there are landmarks.
    Rotation,
    /// Perspective-n-point on window landmarks.
    Pnp,
    /// Either of the two on dense correspondences.
    Dense,
    /// Constant velocity; no image evidence.
    Predicted,
}

/// The road as seen from a keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoadPlane {
    /// Unit normal in camera axes, pointing from the camera to the road.
    pub normal_in_camera: [f64; 3],
    /// Distance of the camera's centre from the road, m.
    pub height_m: f64,
}

/// A triangulated track as seen in the newest keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyframePoint {
    /// Where the keyframe sees it, px.
    pub pixel: [f32; 2],
    /// Distance along the optical axis, m.
    pub depth_m: f32,
    /// Standard deviation of the inverse depth over the inverse depth.
    pub relative_sigma: f32,
}

/// Everything there is to say about one frame, with the numbers that decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameReport {
    /// Index in the stream.
    pub frame_index: u64,
    /// Middle of the exposure.
    pub timestamp_ns: TimestampNs,
    /// Verdict.
    pub status: FrameStatus,
    /// Why.
    pub reason: StatusReason,
    /// What the pose came from.
    pub model: PoseModel,
    /// Where the matches behind it came from.
    pub source: MatchSource,
    /// Whether poses are relative to this frame from here on; where tracking begins anew, a doubtful one.
    pub is_keyframe: bool,
    /// Ordinal of the keyframe that the pose is relative to (itself, when it is one).
    pub keyframe_ordinal: u32,
    /// Pose relative to that keyframe.
    pub keyframe_from_camera: Rigid,
    /// Pose in the odometry world.
    pub world_from_camera: Rigid,
    /// Covariance of `world_from_camera` since the first frame, positive definite: `[theta, p]` along the axes of the
    /// world, see [`conventions`](crate::conventions). Grows with the way driven, and faster while frames are not
    /// tracked.
    pub covariance: Matrix6<f64>,
    /// Live tracks in this frame.
    pub n_tracks: u32,
    /// Matches that went into the solver.
    pub n_matches: u32,
    /// Matches that agree with the pose.
    pub n_inliers: u32,
    /// Matches that the dynamic filter removed.
    pub n_dynamic: u32,
    /// Median displacement against the last keyframe, px at full width.
    pub median_flow_px: f32,
    /// GRIC of the essential matrix and of the homography, where both were tried, else NaN: the lower one is the model.
    pub gric: [f32; 2],
    /// Turn against the prior, rad.
    pub rotation_anomaly_rad: f32,
    /// Angle between the axle's step and the vehicle's forward axis, rad; NaN when the step is too short to tell.
    pub direction_anomaly_rad: f32,
    /// Step length since the keyframe, m.
    pub step_m: f32,
    /// Ratio of the measured scale over the predicted one; NaN when it was not measured.
    pub scale_ratio: f32,
    /// Standard deviation of the natural logarithm of the scale that lengths have by now; more than what the filter claims
    /// where measurements disagree with it.
    pub scale_sigma: f32,
    /// Whose measurements of the scale this frame took over.
    pub scale_sources: ScaleSources,
    /// Road points (or pixels) behind the scale.
    pub n_road: u32,
}

impl FrameReport {
    /// Whether it is a keyframe for people and for the map: one whose own pose was tracked.
    pub fn is_tracked_keyframe(&self) -> bool {
        self.is_keyframe && self.status == FrameStatus::Tracked
    }
}
