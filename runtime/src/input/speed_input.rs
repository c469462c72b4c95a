//! The tracker's end of `<service>/speed`.

use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::PortFactory as _;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use kilogs_camera::ipc::{Ipc, IpcError, IpcNode, Speed, open_speeds};

use super::SpeedRing;
use crate::seal;

/// Readings of the vehicle's speed, from whoever publishes them.
pub(super) struct SpeedInput {
    ring: SpeedRing,
    /// Added to the times of the readings in the ring (wrapping).
    time_shift_ns: u64,
    /// Publishers at the last look. Meeting one takes memory; reading from it does not.
    n_publishers: usize,
    subscriber: Subscriber<Ipc, Speed, ()>,
    service: PortFactory<Ipc, Speed, ()>,
}

impl SpeedInput {
    pub fn open(node: &IpcNode, service: &str, capacity: usize) -> Result<Self, IpcError> {
        let speeds = open_speeds(node, service)?;
        let advice = "another tracker may be attached already: end it, or choose another --service";
        let subscriber =
            speeds.subscriber_builder().create().map_err(|e| IpcError::new("attaching to", service, e, advice))?;
        Ok(Self { ring: SpeedRing::new(capacity), time_shift_ns: 0, n_publishers: 0, subscriber, service: speeds })
    }

    /// Takes in what was published so far. `time_shift_ns` (wrapping) makes the camera's times those of the run.
    pub fn drain(&mut self, time_shift_ns: u64) {
        let n_publishers = self.service.dynamic_config().number_of_publishers();
        let _lifted = (n_publishers != self.n_publishers).then(seal::lift);
        self.n_publishers = n_publishers;
        if time_shift_ns != self.time_shift_ns {
            // The readings of another clock say nothing of what comes.
            self.ring.clear();
            self.time_shift_ns = time_shift_ns;
        }
        // A publisher that dies while it is being connected to is one that says nothing more.
        while let Ok(Some(reading)) = self.subscriber.receive() {
            let timestamp_ns = reading.timestamp_ns.wrapping_add(time_shift_ns);
            self.ring.push(Speed { timestamp_ns, ..*reading });
        }
    }

    pub fn ring(&self) -> &SpeedRing {
        &self.ring
    }
}
