//! Figures of a run, kept in constant memory while it goes on.

use crate::input::{HeaderVerdict, InputCounts};
use crate::output::report::{Percentiles, Tracking};
use crate::output::{DriveChart, Histogram, Stage, StageTimes};
use kilogs_core::scale::{ScaleSource as Source, ScaleSources};
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
    n_refused: u64,
    last_refusal: Option<HeaderVerdict>,
    n_keyframes_dropped: u64,
    scale_source: ScaleSource,
    merged: ScaleSources,
}

/// Where metres come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScaleSource {
    /// What the tracker could measure of these.
    Measured(ScaleSources),
    /// Poses that were given.
    GivenPoses,
}

impl Default for ScaleSource {
    fn default() -> Self {
        Self::Measured(ScaleSources::UNTRAINED)
    }
}

/// The sources with their names in settings and reports.
const NAMES: [(Source, &str); Source::N] = [
    (Source::GroundPlane, "ground_plane"),
    (Source::DepthNetwork, "depth_network"),
    (Source::WheelSpeed, "wheel_speed"),
];

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
        self.pose(report);
    }

    /// Adds a frame that took no time, because its pose was given.
    pub fn pose(&mut self, report: &FrameReport) {
        let is_rejected =
            matches!(report.reason, StatusReason::TurnsTooFast | StatusReason::SlipsSideways | StatusReason::TooFast);
        self.anomalies += u64::from(is_rejected);
        self.merged = self.merged.and(report.scale_sources);
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

    /// Notes a message of the camera that cannot be used.
    pub fn refused(&mut self, verdict: HeaderVerdict) {
        self.n_refused += 1;
        self.last_refusal = Some(verdict);
    }

    /// Messages that were told to be of no use; the input's count at the end has those that nobody was told of, too.
    pub fn n_refused(&self) -> u64 {
        self.n_refused.max(self.input.n_refused)
    }

    /// Why the last message that was of no use is so.
    pub fn last_refusal(&self) -> Option<HeaderVerdict> {
        self.last_refusal
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
            scale_source: self.metres_from(),
            loops: 0,
            path_length_m,
        }
    }

    /// Where metres came from, as in `report.json`; unknown while nothing was measured.
    fn metres_from(&self) -> Option<String> {
        if self.scale_source == ScaleSource::GivenPoses {
            return Some("given_poses".to_owned());
        }
        let names = NAMES.iter().filter(|(source, _)| self.merged.contains(*source)).map(|(_, name)| *name);
        (self.merged != ScaleSources::NONE).then(|| names.collect::<Vec<_>>().join("+"))
    }

    /// Sources that were asked for by name and never told a scale that could be believed. Wheels that nobody publishes are
    /// none of them unless they were asked for.
    pub fn silent_sources(&self) -> impl Iterator<Item = &'static str> {
        let asked = match self.scale_source {
            ScaleSource::Measured(asked) if asked == ScaleSources::UNTRAINED => {
                ScaleSources::of(&[Source::GroundPlane])
            }
            ScaleSource::Measured(asked) => asked,
            ScaleSource::GivenPoses => ScaleSources::NONE,
        };
        let merged = self.merged;
        let is_silent = move |source: Source| asked.contains(source) && !merged.contains(source);
        NAMES.iter().filter(move |(source, _)| is_silent(*source)).map(|(_, name)| *name)
    }
}
