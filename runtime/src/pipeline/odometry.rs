//! The odometry that robots read while the vehicle drives.
//!
//! Publishing takes memory for every message, so it has a thread of its own, which nobody seals and nobody waits for.

use super::loops::SharedAlignment;
use super::plan::RunPlan;
use super::queue::Receiver;
use crate::output::OdometryPublisher;
use crate::run_error::RunError;
use kilogs_camera::ipc::OdometryMessage;
use kilogs_core::conventions::{Rigid, Similarity, TimestampNs, quaternion_xyzw};
use kilogs_core::loop_closure::MapAlignment;
use kilogs_core::tracking::{FrameReport, FrameStatus};

const NS_PER_S: f64 = 1e9;

/// Frames that can wait to be published; a reader that late wants newer ones.
pub const CAPACITY: usize = 16;

/// Publishes what comes until nothing more will.
///
/// # Errors
/// [`RunError::Input`] when the shared memory cannot be used.
pub fn publish(frames: &Receiver<FrameReport>, plan: &RunPlan, alignment: &SharedAlignment) -> Result<(), RunError> {
    let begins_at = Similarity::from_isometry(plan.map_from_odometry(), 1.0);
    let mut followed = MapAlignment::new(begins_at, plan.settings.loop_closure.alignment);
    let mut stream = OdometryStream::open()?;
    let mut n_found = alignment.n_found();
    while let Some(report) = frames.pop() {
        // Read before the alignment, which is written first: what is found is never followed in steps.
        let n_found_by_now = alignment.n_found();
        let wanted = alignment.lock().newest() * begins_at;
        if n_found_by_now != n_found {
            n_found = n_found_by_now;
            followed = MapAlignment::new(wanted, plan.settings.loop_closure.alignment);
        }
        let map_from_odometry = followed.follow(&wanted, &report.world_from_camera);
        stream.publish(&report, &map_from_odometry);
    }
    Ok(())
}

/// Publishes one message per frame.
struct OdometryStream {
    publisher: OdometryPublisher,
    before: Option<(TimestampNs, Rigid)>,
}

impl OdometryStream {
    fn open() -> Result<Self, RunError> {
        let publisher = OdometryPublisher::open().map_err(|e| RunError::Input(e.to_string()))?;
        Ok(Self { publisher, before: None })
    }

    /// A message that cannot be sent is a loss for the reader, not for the run.
    fn publish(&mut self, report: &FrameReport, map_from_odometry: &Similarity) {
        let message = self.message(report, map_from_odometry);
        self.before = Some((report.timestamp_ns, report.world_from_camera));
        if let Err(problem) = self.publisher.publish(&message) {
            log::debug!("{problem}");
        }
    }

    fn message(&self, report: &FrameReport, map_from_odometry: &Similarity) -> OdometryMessage {
        let odometry_from_camera = &report.world_from_camera;
        let velocity_in_camera_m_per_s = match &self.before {
            Some((before_ns, odometry_from_before)) if report.timestamp_ns > *before_ns => {
                let passed_s = (report.timestamp_ns - before_ns) as f64 / NS_PER_S;
                let camera_from_before = odometry_from_camera.inverse() * odometry_from_before;
                (-camera_from_before.translation.vector / passed_s).into()
            }
            _ => [0.0; 3],
        };
        OdometryMessage {
            sequence: report.frame_index,
            timestamp_ns: report.timestamp_ns,
            status: match report.status {
                FrameStatus::Tracked => 0,
                FrameStatus::Doubtful => 1,
                FrameStatus::Lost => 2,
            },
            is_keyframe: u32::from(report.is_tracked_keyframe()),
            odometry_from_camera_m: odometry_from_camera.translation.vector.into(),
            odometry_from_camera_xyzw: quaternion_xyzw(&odometry_from_camera.rotation),
            map_from_odometry_m: map_from_odometry.isometry.translation.vector.into(),
            map_from_odometry_xyzw: quaternion_xyzw(&map_from_odometry.isometry.rotation),
            map_from_odometry_scale: map_from_odometry.scaling(),
            velocity_in_camera_m_per_s,
            covariance: covariance(report),
        }
    }
}

/// The tracker's covariance, row by row.
fn covariance(report: &FrameReport) -> [f64; 36] {
    std::array::from_fn(|i| report.covariance[(i / 6, i % 6)])
}
