//! Figures of a run, kept in constant memory while it goes on.

use crate::input::InputCounts;
use crate::output::report::{Percentiles, Tracking};
use crate::output::{DriveChart, Histogram, Stage, StageTimes};
use kilogs_core::tracking::{FrameReport, FrameStatus, PoseModel, StatusReason};
use nalgebra::Vector3;

/// Figures of a run.
#[derive(Default)]
pub struct Tally {
    per_frame: Histogram,
    tracking: Histogram,
    chart: DriveChart,
    essential: u64,
    pnp: u64,
    dense: u64,
    anomalies: u64,
    odometry_length_m: f64,
    last_position_m: Option<Vector3<f64>>,
    input: InputCounts,
    n_keyframes_dropped: u64,
    scale_source: ScaleSource,
}

/// Where metres come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ScaleSource {
    /// The camera's height over the road.
    #[default]
    GroundPlane,
    /// A trained network's depth.
    DepthNetwork,
    /// The vehicle's wheels.
    WheelSpeed,
    /// Poses that were given.
    GivenPoses,
}

impl Tally {
    /// A tally of a run whose metres come from elsewhere.
    pub fn with_scale_source(scale_source: ScaleSource) -> Self {
        Self { scale_source, ..Self::default() }
    }

    /// Adds a frame; `rss_bytes` is the latest resident size.
    pub fn frame(&mut self, report: &FrameReport, times: &StageTimes, rss_bytes: u64) {
        // Waiting for the camera is not our time.
        let own_ms = times.total_ms() - times.ms(Stage::Input);
        self.per_frame.push(f64::from(own_ms));
        self.tracking.push(f64::from(times.ms(Stage::Tracking)));
        self.chart.push(times, rss_bytes);
        let is_rejected =
            matches!(report.reason, StatusReason::TurnsTooFast | StatusReason::SlipsSideways | StatusReason::TooFast);
        self.anomalies += u64::from(is_rejected);
        match (report.status, report.model) {
            (FrameStatus::Doubtful, _) => {}
            (_, PoseModel::Essential) => self.essential += 1,
            (_, PoseModel::Pnp) => self.pnp += 1,
            (_, PoseModel::Dense) => self.dense += 1,
            (_, PoseModel::Origin | PoseModel::Rotation | PoseModel::Predicted) => {}
        }
        let position_m = report.world_from_camera.translation.vector;
        if report.status != FrameStatus::Lost {
            if let Some(before_m) = self.last_position_m {
                self.odometry_length_m += (position_m - before_m).norm();
            }
            self.last_position_m = Some(position_m);
        }
    }

    /// Notes what the input counted in all.
    pub fn end(&mut self, input: InputCounts, n_keyframes_dropped: u64) {
        self.input = input;
        self.n_keyframes_dropped = n_keyframes_dropped;
    }

    /// Way of the live odometry so far, m.
    pub fn odometry_length_m(&self) -> f64 {
        self.odometry_length_m
    }

    /// What the input counted in all.
    pub fn input(&self) -> &InputCounts {
        &self.input
    }

    /// Keyframes that found no room on their way to the mapper.
    pub fn n_keyframes_dropped(&self) -> u64 {
        self.n_keyframes_dropped
    }

    /// Time of a frame through the whole pipeline, and through the tracker.
    pub fn percentiles(&self) -> (Percentiles, Percentiles) {
        (self.per_frame.percentiles(), self.tracking.percentiles())
    }

    /// Time and memory over the drive.
    pub fn chart(&self) -> &DriveChart {
        &self.chart
    }

    /// The report's section on tracking.
    pub fn tracking(&self, path_length_m: f64) -> Tracking {
        Tracking {
            essential: self.essential,
            pnp: self.pnp,
            dense_fallback: self.dense,
            anomalies: self.anomalies,
            scale_source: Some(self.scale_source.name().to_owned()),
            loops: 0,
            path_length_m,
        }
    }
}

impl From<kilogs_core::scale::ScaleSource> for ScaleSource {
    fn from(source: kilogs_core::scale::ScaleSource) -> Self {
        match source {
            kilogs_core::scale::ScaleSource::GroundPlane => Self::GroundPlane,
            kilogs_core::scale::ScaleSource::DepthNetwork => Self::DepthNetwork,
            kilogs_core::scale::ScaleSource::WheelSpeed => Self::WheelSpeed,
        }
    }
}

impl ScaleSource {
    /// As in `report.json`.
    fn name(self) -> &'static str {
        match self {
            Self::GroundPlane => "ground_plane",
            Self::DepthNetwork => "depth_network",
            Self::WheelSpeed => "wheel_speed",
            Self::GivenPoses => "given_poses",
        }
    }
}
