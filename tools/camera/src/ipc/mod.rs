//! What crosses the border between processes, and under which names.
//!
//! | service | direction | payload |
//! |---|---|---|
//! | `<service>/frames` | camera to tracker | pixels in [`FramePage`]s, [`FrameHeader`] beside them |
//! | `<service>/ack` | tracker to camera | [`Ack`]: this frame is done with |
//! | `<service>/speed` | vehicle to tracker, optional | [`Speed`] |
//! | `kilogs/odometry` | tracker to anyone | [`OdometryMessage`] per frame |
//! | `kilogs/health` | tracker to anyone | [`HealthMessage`] per second |
//!
//! `frames` and `ack` have an event service of the same name, so that nobody polls.

mod header;
mod messages;
mod services;

pub use header::{
    FRAME_MAGIC, FRAME_VERSION, FrameHeader, HeaderVerdict, MAX_SEQUENCE_STEP, MAX_TIME_STEP_NS, PreviousFrame,
    ServiceFormat, flags,
};
pub use messages::{Ack, FramePage, HealthMessage, OdometryMessage, PAGE_BYTES, Speed};
pub use services::{
    AckService, EventService, FrameService, FrameSlots, HEALTH_SERVICE, Ipc, IpcError, IpcNode, ODOMETRY_SERVICE,
    ack_name, create_node, frames_name, open_acks, open_events, open_frames, open_messages, open_speeds, parse_service,
    speed_name, unique_service_name,
};
