//! Where frames come in: the camera service, read in place, and the camera child of a replay.

mod borrowed_frame;
mod camera_child;
mod camera_link;
mod counts;
mod frame_input;
mod mapping;
mod session;
mod speed_input;
mod speed_ring;

pub use borrowed_frame::BorrowedFrame;
pub use camera_child::CameraChild;
pub use counts::{CameraState, InputCounts};
pub use frame_input::{FrameInput, InputEvent, InputSettings};
pub use kilogs_camera::ipc::{FrameSlots, HeaderVerdict, ServiceFormat, unique_service_name};
pub use mapping::SharedMapping;
pub use speed_ring::{Distance, MAX_GAP_NS, SpeedRing};

/// Why frames cannot come in.
#[derive(Debug, thiserror::Error)]
pub enum InputError {
    /// The communication could not be set up, or broke down.
    #[error(transparent)]
    Ipc(#[from] kilogs_camera::ipc::IpcError),
    /// The camera process could not be started.
    #[error("starting the camera process {program}: {source}; is the program still where it was?")]
    Start {
        /// What was started.
        program: String,
        /// What the system answered.
        source: std::io::Error,
    },
    /// The thread that acknowledges frames could not be started.
    #[error("starting the thread that acknowledges frames: {0}; are there too many processes?")]
    Thread(std::io::Error),
}
