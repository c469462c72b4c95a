//! What came in, and how the camera process is.

use std::time::Duration;

/// Frames by what became of them before they reached the tracker.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct InputCounts {
    /// Handed to the tracker.
    pub n_received: u64,
    /// Refused for their header.
    pub n_refused: u64,
    /// Missing by their sequence numbers: overwritten before they were read, or never readable.
    pub n_missing: u64,
    /// How often another camera process took over.
    pub n_restarts: u32,
    /// Attempts to connect to a camera process that failed, because it died or its memory cannot be mapped.
    pub n_connection_failures: u64,
    /// Acknowledgements that could not be sent.
    pub n_ack_failures: u64,
}

/// How the camera process is. The numbers are those of the health message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub enum CameraState {
    /// No camera process was seen yet.
    NeverCame = 0,
    /// It is there and frames arrive.
    Sending = 1,
    /// It is there, but the last wait brought no frame.
    Silent = 2,
    /// It died or left without ending the stream.
    Gone = 3,
    /// It ended the stream.
    Ended = 4,
}

impl CameraState {
    /// One sentence for the operator: what the camera of `service` does, and what to try.
    pub fn describe(self, service: &str, silent_for: Duration) -> String {
        let silent_s = silent_for.as_secs_f64();
        match self {
            Self::NeverCame => format!(
                "waiting for a camera at \"{service}\": none within {silent_s:.1} s; is the camera process running \
                 with --service {service}?"
            ),
            Self::Sending => format!("the camera at \"{service}\" sends"),
            Self::Silent => format!(
                "the camera process at \"{service}\" lives but has sent nothing for {silent_s:.1} s; is it stopped, \
                 or its cable loose?"
            ),
            Self::Gone => format!(
                "the camera process at \"{service}\" is gone, last frame {silent_s:.1} s ago; waiting for it to be \
                 started again"
            ),
            Self::Ended => format!("the camera at \"{service}\" ended its stream"),
        }
    }
}
