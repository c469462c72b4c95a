//! `frames.csv`: one row per received frame, with the numbers behind its verdict.

use super::number::{Measured, Seconds};
use super::sink::TextSink;
use super::{OutputError, STAGES, StageTimes};
use kilogs_core::conventions::TimestampNs;
use kilogs_core::tracking::{FrameReport, FrameStatus, MatchSource, PoseModel, StatusReason};

/// Columns before the milliseconds per stage.
const COLUMNS: &str = "index,t,status,reason,keyframe,model,matches,n_tracks,n_matches,n_inliers,n_dynamic,n_road,median_flow_px,\
     gric_essential,gric_homography,rotation_anomaly_deg,direction_anomaly_deg,step_m,scale_ratio,scale_sigma";

/// Columns of a dropped frame between its status and its (absent) stage times.
const NOTHING_MEASURED: &str = ",never_arrived,0,,,,,,,,,,,,,,,";

pub(super) fn write_header(csv: &mut TextSink) -> Result<(), OutputError> {
    csv.write(format_args!("{COLUMNS}"))?;
    STAGES.iter().try_for_each(|(_, name)| csv.write(format_args!(",{name}_ms")))?;
    csv.write(format_args!("\n"))
}

pub(super) fn write_frame(csv: &mut TextSink, frame: &FrameReport, times: &StageTimes) -> Result<(), OutputError> {
    csv.write(format_args!(
        "{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
        frame.frame_index,
        Seconds(frame.timestamp_ns),
        status_name(frame.status),
        reason_name(frame.reason),
        u8::from(frame.is_tracked_keyframe()),
        model_name(frame.model),
        source_name(frame.source),
        frame.n_tracks,
        frame.n_matches,
        frame.n_inliers,
        frame.n_dynamic,
        frame.n_road,
        Measured(frame.median_flow_px),
        Measured(frame.gric[0]),
        Measured(frame.gric[1]),
        Measured(frame.rotation_anomaly_rad.to_degrees()),
        Measured(frame.direction_anomaly_rad.to_degrees()),
        Measured(frame.step_m),
        Measured(frame.scale_ratio),
        Measured(frame.scale_sigma),
    ))?;
    STAGES.iter().try_for_each(|&(stage, _)| csv.write(format_args!(",{}", Measured(times.ms(stage)))))?;
    csv.write(format_args!("\n"))
}

pub(super) fn write_dropped(
    csv: &mut TextSink,
    frame_index: u64,
    timestamp_ns: Option<TimestampNs>,
) -> Result<(), OutputError> {
    match timestamp_ns {
        Some(ns) => csv.write(format_args!("{frame_index},{},dropped{NOTHING_MEASURED}", Seconds(ns)))?,
        None => csv.write(format_args!("{frame_index},,dropped{NOTHING_MEASURED}"))?,
    }
    STAGES.iter().try_for_each(|_| csv.write(format_args!(",")))?;
    csv.write(format_args!("\n"))
}

fn status_name(status: FrameStatus) -> &'static str {
    match status {
        FrameStatus::Tracked => "tracked",
        FrameStatus::Doubtful => "doubtful",
        FrameStatus::Lost => "lost",
    }
}

fn reason_name(reason: StatusReason) -> &'static str {
    match reason {
        StatusReason::Verified => "verified",
        StatusReason::FirstFrame => "first_frame",
        StatusReason::Frozen => "frozen",
        StatusReason::TooFewMatches => "too_few_matches",
        StatusReason::TooFewInliers => "too_few_inliers",
        StatusReason::TurnsTooFast => "turns_too_fast",
        StatusReason::SlipsSideways => "slips_sideways",
        StatusReason::TooFast => "too_fast",
        StatusReason::Restarted => "restarted",
        StatusReason::Unusable => "unusable",
    }
}

fn source_name(source: MatchSource) -> &'static str {
    match source {
        MatchSource::Tracks => "tracks",
        MatchSource::Sparse => "sparse",
        MatchSource::Dense => "dense",
    }
}

fn model_name(model: PoseModel) -> &'static str {
    match model {
        PoseModel::Origin => "origin",
        PoseModel::Essential => "E",
        PoseModel::Rotation => "rotation",
        PoseModel::Pnp => "PnP",
        PoseModel::Dense => "dense",
        PoseModel::Predicted => "predicted",
    }
}
