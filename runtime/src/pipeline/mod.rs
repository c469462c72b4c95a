//! A run from its first frame to its report.
//!
//! ```text
//! tracking thread (sealed)   input -> tracker -> odometry      never waits for mapping or the disk when live
//!        | keyframes              | one record per frame
//! mapping thread (sealed)         |                            trains in the time left; hands pages to the store
//! loops thread                    |                            recognizes places, moves the map
//!        | pages, images          |
//! map-store thread           this thread                       files, memory watch, health, progress, Ctrl-C
//! ```

mod camera_image;
mod child_watch;
mod finish;
mod given_poses;
pub(crate) mod loops;
mod mapper_link;
mod mapping_thread;
mod matchers;
mod memory;
mod nothing_tracked;
mod odometry;
mod plan;
mod priority;
mod queue;
mod record;
mod resume;
mod supervisor;
mod tally;
mod tracking_thread;

pub(crate) use finish::{Concluded, conclude};
pub use given_poses::GivenPosesPlan;
pub(crate) use mapping_thread::MappingSummary;
pub(crate) use memory::{backend, manifest, mapper, store_settings};
pub use plan::{Pace, RunPlan};
pub use resume::Resume;
pub(crate) use supervisor::Told;
pub(crate) use tally::{ScaleSource, Tally};

use crate::input::{CameraChild, InputError};
use crate::run_error::RunError;

/// Runs with a capture process of its own; `start` starts it on the service name that it is given.
///
/// # Errors
/// [`RunError`]; what was tracked and mapped until then is written all the same.
pub fn run_with_child(
    plan: RunPlan,
    start: impl FnOnce(&str) -> Result<CameraChild, InputError>,
) -> Result<(), RunError> {
    let service = crate::input::unique_service_name("replay");
    supervisor::supervise(&plan, &service, || start(&service).map(Some))
}

/// Runs on a camera that other people start and stop.
///
/// # Errors
/// [`RunError`].
pub fn run_attached(plan: RunPlan, service: &str) -> Result<(), RunError> {
    supervisor::supervise(&plan, service, || Ok(None))
}
