//! What the tracking thread tells the main thread; fixed size, so that telling takes no memory.

use crate::input::{CameraState, InputCounts};
use crate::output::StageTimes;
use kilogs_camera::ipc::HeaderVerdict;
use kilogs_core::tracking::FrameReport;
use std::time::Duration;

/// One message.
#[derive(Debug, Clone, Copy)]
#[allow(
    clippy::large_enum_variant,
    reason = "a box takes memory on a sealed thread, and nearly all records are frames"
)]
pub enum Record {
    /// A frame went through the tracker.
    Frame {
        /// What the tracker says.
        report: FrameReport,
        /// Where the time went.
        times: StageTimes,
    },
    /// A message from the camera could not be used.
    Refused(HeaderVerdict),
    /// A camera process is there.
    CameraCame {
        /// No other one came before it.
        is_first: bool,
    },
    /// The camera process died or left.
    CameraGone {
        /// How long ago its last frame arrived.
        silent_for: Duration,
    },
    /// Nothing happened for a while.
    Waiting {
        /// How the camera is.
        camera: CameraState,
        /// How long ago its last frame arrived.
        silent_for: Duration,
    },
    /// Nothing more will come.
    End {
        /// What came in.
        input: InputCounts,
        /// How the camera is.
        camera: CameraState,
        /// Index after the last frame, counting missing ones.
        n_frame_indices: u64,
        /// Keyframes that found no room on their way to the mapper.
        n_keyframes_dropped: u64,
    },
}
