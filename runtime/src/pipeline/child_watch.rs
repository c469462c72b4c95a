//! What people see of the capture process: how far it is, and why it failed.

use crate::input::CameraChild;
use crate::run_error::RunError;
use indicatif::{ProgressBar, ProgressStyle};
use std::time::Duration;

/// Exit code after a camera process that ended by a signal.
const RUN_FAILED: u8 = 1;

/// How long the camera child may take to end by itself.
const END_PATIENCE: Duration = Duration::from_secs(2);

/// Why the camera child failed; it has ended or is about to.
pub fn camera_failure(child: &mut CameraChild) -> Option<RunError> {
    match child.wait(END_PATIENCE) {
        Some(status) if status.success() => None,
        Some(status) => {
            let code = status.code().and_then(|code| u8::try_from(code).ok()).unwrap_or(RUN_FAILED);
            let text = format!("the camera process failed ({status}); what it said stands above");
            Some(RunError::Camera { code, text })
        }
        // It is still there because the run was stopped, not because of a fault of its own.
        None => None,
    }
}

/// A bar over the frames that will come, where their number is known.
pub fn progress_bar(n_frames: Option<u64>) -> ProgressBar {
    let (bar, template) = match n_frames {
        Some(n_frames) => (ProgressBar::new(n_frames), "{bar:40} {pos}/{len} frames, {per_sec}, {eta} left"),
        None => (ProgressBar::new_spinner(), "{spinner} {pos} frames, {per_sec}"),
    };
    match ProgressStyle::with_template(template) {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}
