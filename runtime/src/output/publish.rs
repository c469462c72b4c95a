//! Odometry per frame and health per second, for whoever listens; published by the odometry and the main thread.

use std::fmt::Debug;

use iceoryx2::port::publisher::Publisher;
use iceoryx2::prelude::ZeroCopySend;
use kilogs_camera::ipc::{
    HEALTH_SERVICE, HealthMessage, Ipc, IpcError, IpcNode, ODOMETRY_SERVICE, OdometryMessage, create_node,
    open_messages,
};

/// Publishes [`OdometryMessage`]s at [`ODOMETRY_SERVICE`].
pub type OdometryPublisher = MessagePublisher<OdometryMessage>;

/// Publishes [`HealthMessage`]s at [`HEALTH_SERVICE`].
pub type HealthPublisher = MessagePublisher<HealthMessage>;

/// Publishes small messages; the oldest of a slow reader are overwritten.
///
/// iceoryx2 takes two small blocks from the heap per message: publish from a thread that is not sealed.
pub struct MessagePublisher<Message: Debug + ZeroCopySend + Copy + 'static> {
    name: &'static str,
    publisher: Publisher<Ipc, Message, ()>,
    _node: IpcNode,
}

impl OdometryPublisher {
    /// Opens `kilogs/odometry`.
    ///
    /// # Errors
    /// [`IpcError`] when the shared memory cannot be used or too many trackers publish already.
    pub fn open() -> Result<Self, IpcError> {
        Self::open_at(ODOMETRY_SERVICE)
    }
}

impl HealthPublisher {
    /// Opens `kilogs/health`.
    ///
    /// # Errors
    /// [`IpcError`] as [`OdometryPublisher::open`].
    pub fn open() -> Result<Self, IpcError> {
        Self::open_at(HEALTH_SERVICE)
    }
}

impl<Message: Debug + ZeroCopySend + Copy + 'static> MessagePublisher<Message> {
    fn open_at(name: &'static str) -> Result<Self, IpcError> {
        let node = create_node(name)?;
        let service = open_messages::<Message>(&node, name)?;
        let advice = "too many trackers may publish under this name: end some";
        let publisher =
            service.publisher_builder().create().map_err(|e| IpcError::new("publishing at", name, e, advice))?;
        Ok(Self { name, publisher, _node: node })
    }

    /// Hands the message to all who listen.
    ///
    /// # Errors
    /// [`IpcError`] when the shared memory breaks down; tracking can go on without.
    pub fn publish(&self, message: &Message) -> Result<(), IpcError> {
        let advice = "check the space in /dev/shm";
        let sent = self.publisher.send_copy(*message);
        sent.map(|_| ()).map_err(|e| IpcError::new("publishing at", self.name, e, advice))
    }
}
