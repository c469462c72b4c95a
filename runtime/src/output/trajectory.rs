//! Expands the logs of a run into its trajectory files.

use super::OutputError;
use super::frame_log::FrameLogReader;
use super::keyframe_table::{KeyframeTable, PlacedKeyframe};
use super::number::{Coordinate, Seconds};
use super::sink::TextSink;
use kilogs_core::conventions::{Rigid, TimestampNs, quaternion_xyzw};
use nalgebra::Translation3;
use std::path::Path;

/// What the trajectory files hold.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct TrajectorySummary {
    /// Frames with a pose.
    pub n_poses: u64,
    /// Keyframes.
    pub n_keyframes: u64,
    /// Length of the path through all poses, m.
    pub path_length_m: f64,
}

/// Writes `trajectory_tum.txt`, `keyframes_tum.txt` and `trajectory_kitti.txt`.
pub(super) fn expand(
    dir: &Path,
    frames: &mut FrameLogReader,
    keyframes: &mut KeyframeTable,
) -> Result<TrajectorySummary, OutputError> {
    let mut summary = TrajectorySummary::default();
    let mut tum = TextSink::create(dir.join("trajectory_tum.txt"))?;
    let mut kitti = TextSink::create(dir.join("trajectory_kitti.txt"))?;
    let mut world_from_last: Option<Rigid> = None;
    while let Some(frame) = frames.next_frame()? {
        let keyframe = match frame {
            Some(frame) => keyframes.get(frame.keyframe_ordinal)?,
            None => None,
        };
        if let (Some(frame), Some(keyframe)) = (frame, keyframe) {
            let world_from_camera = expanded(&keyframe, &frame.keyframe_from_camera);
            write_tum(&mut tum, frame.timestamp_ns, &world_from_camera)?;
            summary.n_poses += 1;
            let step_m = |last: Rigid| (world_from_camera.translation.vector - last.translation.vector).norm();
            summary.path_length_m += world_from_last.map_or(0.0, step_m);
            world_from_last = Some(world_from_camera);
        }
        // The format has no word for "no pose": line k must stay frame k, so the last pose stands in.
        write_kitti(&mut kitti, &world_from_last.unwrap_or_default())?;
    }
    tum.finish()?;
    kitti.finish()?;

    let mut tum = TextSink::create(dir.join("keyframes_tum.txt"))?;
    for ordinal in 0..keyframes.len() {
        if let Some(keyframe) = keyframes.get(ordinal)?.filter(|keyframe| keyframe.is_tracked) {
            write_tum(&mut tum, keyframe.timestamp_ns, &keyframe.world_from_keyframe)?;
            summary.n_keyframes += 1;
        }
    }
    tum.finish()?;
    Ok(summary)
}

/// A pose relative to a keyframe that a loop closure may have moved, turned and scaled.
fn expanded(keyframe: &PlacedKeyframe, keyframe_from_camera: &Rigid) -> Rigid {
    let scaled_m = keyframe_from_camera.translation.vector * keyframe.scale;
    keyframe.world_from_keyframe * Rigid::from_parts(Translation3::from(scaled_m), keyframe_from_camera.rotation)
}

/// One line `t x y z qx qy qz qw`.
pub(super) fn write_tum(
    tum: &mut TextSink,
    timestamp_ns: TimestampNs,
    world_from_camera: &Rigid,
) -> Result<(), OutputError> {
    let t = world_from_camera.translation.vector.map(Coordinate);
    let [qx, qy, qz, qw] = quaternion_xyzw(&world_from_camera.rotation).map(Coordinate);
    tum.write(format_args!("{} {} {} {} {qx} {qy} {qz} {qw}\n", Seconds(timestamp_ns), t[0], t[1], t[2]))
}

/// One line with the upper 3x4 part of the matrix, row by row.
fn write_kitti(kitti: &mut TextSink, world_from_camera: &Rigid) -> Result<(), OutputError> {
    let rotation = world_from_camera.rotation.to_rotation_matrix();
    let r = rotation.matrix().map(Coordinate);
    let t = world_from_camera.translation.vector.map(Coordinate);
    for row in 0..3 {
        let end = if row == 2 { '\n' } else { ' ' };
        kitti.write(format_args!("{} {} {} {}{end}", r[(row, 0)], r[(row, 1)], r[(row, 2)], t[row]))?;
    }
    Ok(())
}
