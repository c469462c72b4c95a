//! Every constant of the tracker, with unit, range and source.

use super::recovery::MatchSource;
use crate::camera::Pinhole;
use crate::features::tracks::TrackSettings;
use crate::gate::GateSettings;
use crate::pose::{PnpSettings, RelativeSettings};
use crate::scale::{RoadSettings, ScaleFilterSettings, ScaleSources};
use crate::verify::MotionLimits;

/// Which solvers may find the pose of a frame once there are landmarks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseModels {
    /// Landmarks first, the essential matrix where they do not answer or are not believed.
    Both,
    /// The essential matrix only; landmarks give the length of the step.
    Essential,
    /// Landmarks only.
    Pnp,
}

/// What removes matches on moving objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DynamicFilter {
    /// Nothing but the robust solvers.
    Off,
    /// Flow beyond median + 3 MAD over the whole image (paper).
    Paper,
    /// The geometry decides: landmarks below the road or behind the camera are not part of the street (ours).
    Region,
}

/// Constants of the tracker. Lengths in pixels are those of the image that comes in.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TrackingSettings {
    /// Corners and their tracks.
    pub tracks: TrackSettings,
    /// When a frame becomes a keyframe.
    pub gate: GateSettings,
    /// Solvers in use.
    pub pose_models: PoseModels,
    /// Filter of moving objects.
    pub dynamic_filter: DynamicFilter,
    /// Whether the window is adjusted at every keyframe.
    pub bundle_adjustment: bool,
    /// Standard deviation of a track's position, px. Range 0.05..2; ours, from reprojection errors on KITTI.
    pub noise_px: f64,
    /// Standard deviation of a track that a matcher found again, px. Range 0.05..5; ours.
    pub matched_noise_px: f64,
    /// Noise of a match in the choice between essential matrix and homography, px. Range 0.1..5; paper, supplement. A camera
    /// with larger pixels or noise needs another one.
    pub gric_sigma_px: f64,
    /// Sampson distance below which a match agrees with an essential matrix, px. Range 0.1..4; peers use 0.2..1.
    pub essential_inlier_px: f64,
    /// Most samples of the robust loops. Range 20..5000.
    pub max_trials: usize,
    /// Wanted probability that a robust loop saw a sample without outliers. Range 0.9..1.
    pub confidence: f64,
    /// Error in standard deviations below which a landmark agrees with a pose. Range 2..10; ours: 3 of 0.35 px is
    /// the paper's 1 px.
    pub pnp_inlier_sigmas: f64,
    /// Fewest agreeing matches that make a pose. Range 6..200.
    pub min_inliers: usize,
    /// Agreeing matches with which a pose needs no second opinion by a matcher, where there is one. Range 6..1000; ours:
    /// among fewer, a consensus of outliers passed for a pose in darkness and after gaps.
    pub enough_inliers: usize,
    /// Share of matches that must agree. Range 0..1.
    pub min_inlier_ratio: f64,
    /// Share of inliers that must lie in front of both cameras. Range 0..1; peers use 0.1.
    pub min_in_front_ratio: f64,
    /// Median displacement below which the vehicle stands, px. Range 0.05..2. Ours.
    pub standing_flow_px: f64,
    /// Median displacement at which the first two keyframes are made, px at 1241 px width. Range 2..50. Ours.
    pub first_flow_px: f64,
    /// Frames without a believed pose after which the window is started anew. Range 1..100. Ours.
    pub max_doubtful_frames: u32,
    /// Fewest corners in a frame that can be tracked at all. Range 8..500.
    pub min_corners: usize,
    /// Newton steps of the bundle adjustment. Range 1..50.
    pub bundle_iterations: usize,
    /// Error in standard deviations beyond which the bundle adjustment drops a landmark. Range 2..20.
    pub outlier_sigmas: f64,
    /// A landmark seen below the road at less than this share of the road's inverse depth moves. Range 0..1. Ours.
    pub below_road_ratio: f64,
    /// Share of each road measurement that the expected normal takes over. Range 0..1; 0 keeps the mounting's.
    pub normal_adaptation: f64,
    /// Largest deviation of the expected normal from the mounting's, rad. Range 0..0.2.
    pub max_normal_deviation_rad: f64,
    /// What may tell the scale. The road measures the first step whatever is asked for, where nothing else does.
    pub scale_sources: ScaleSources,
    /// What brakes can do, m/s^2: a vehicle that would have to brake harder to stand still from one image to the next has a
    /// camera that hangs. Range 1..30; tyres on a dry street reach 10.
    pub hardest_braking_m_per_s2: f64,
    /// The road's alignment.
    pub road: RoadSettings,
    /// How scale measurements are merged.
    pub scale: ScaleFilterSettings,
    /// What a vehicle cannot do.
    pub motion: MotionLimits,
}

impl TrackingSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        tracks: TrackSettings::STANDARD,
        gate: GateSettings::STANDARD,
        pose_models: PoseModels::Both,
        dynamic_filter: DynamicFilter::Region,
        bundle_adjustment: true,
        noise_px: 0.35,
        matched_noise_px: 0.7,
        gric_sigma_px: 0.8,
        essential_inlier_px: 0.7,
        max_trials: 300,
        confidence: 0.999,
        pnp_inlier_sigmas: 3.0,
        min_inliers: 15,
        enough_inliers: 40,
        min_inlier_ratio: 0.3,
        min_in_front_ratio: 0.1,
        standing_flow_px: 0.4,
        first_flow_px: 12.0,
        max_doubtful_frames: 5,
        min_corners: 30,
        bundle_iterations: 8,
        outlier_sigmas: 4.0,
        below_road_ratio: 0.5,
        normal_adaptation: 0.05,
        max_normal_deviation_rad: 0.05,
        scale_sources: ScaleSources::UNTRAINED,
        hardest_braking_m_per_s2: 10.0,
        road: RoadSettings {
            distance_m: [5.0, 16.0],
            half_width_m: 3.0,
            standing_grey: 2.0,
            bend: 1.0,
            normal_sigma_rad: [0.01, 0.004],
            working_width_px: 600,
            max_iterations: 15,
            min_pixels: 200,
            min_correlation: 0.6,
            min_margin: 5.0,
            min_flow_px: 3.0,
        },
        scale: ScaleFilterSettings {
            first_sigma: 1.0,
            drift_per_sqrt_m: 0.002,
            turn_drift_per_sqrt_rad: 0.04,
            drift_rate_sigma_per_m: 0.0005,
            drift_rate_change_per_m: 0.00002,
            measurement_sigma: 0.03,
            network_sigma: 0.05,
            wheel_sigma: 0.01,
            correlation_m: 5.0,
            early_sigma: 0.2,
            kernel_sigmas: 2.0,
            max_jump: 2.0,
            gate_sigmas: 4.0,
        },
        motion: MotionLimits {
            max_turn_change_rad_per_s: 0.87,
            max_side_slip_rad: 0.262,
            min_step_m: 0.3,
            max_speed_m_per_s: 70.0,
            max_acceleration_m_per_s2: 50.0,
            reverse_allowed: false,
        },
    };

    pub(super) fn noise_z1(&self, camera: &Pinhole) -> f64 {
        self.noise_px / camera.fx
    }

    /// Standard deviation of matches, px.
    pub(super) fn noise_px_of(&self, source: MatchSource) -> f64 {
        if source == MatchSource::Tracks { self.noise_px } else { self.matched_noise_px.max(self.noise_px) }
    }

    /// `noise_px`: standard deviation of the matches that it is for.
    pub(super) fn relative(&self, camera: &Pinhole, noise_px: f64) -> RelativeSettings {
        RelativeSettings {
            inlier_z1: self.essential_inlier_px * (noise_px / self.noise_px) / camera.fx,
            confidence: self.confidence,
            trials: [FEWEST_TRIALS, self.max_trials],
            local_iterations: LOCAL_ITERATIONS,
        }
    }

    /// `noise_px`: standard deviation of the matches that it is for.
    pub(super) fn pnp(&self, camera: &Pinhole, noise_px: f64) -> PnpSettings {
        PnpSettings {
            noise_z1: noise_px / camera.fx,
            inlier_sigmas: self.pnp_inlier_sigmas,
            confidence: self.confidence,
            trials: [0, self.max_trials],
            iterations: LOCAL_ITERATIONS,
        }
    }
}

/// Samples drawn even when the prediction explains everything.
const FEWEST_TRIALS: usize = 5;
/// Iterations of the solvers' refinements.
const LOCAL_ITERATIONS: usize = 10;
