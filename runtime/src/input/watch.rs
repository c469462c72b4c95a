//! Clears away camera processes that were killed, so that the tracking thread notices and is woken.
//!
//! Looking for dead processes reads directories and allocates; it has a thread of its own, so that the tracking
//! thread only ever reads a counter in shared memory.

use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::thread::JoinHandle;
use std::time::Duration;

use iceoryx2::prelude::PortFactory;
use kilogs_camera::ipc::{FrameSlots, create_node, open_frames};

use super::InputError;

/// A camera that is killed is noticed within this and a little more.
const LOOK_INTERVAL: Duration = Duration::from_millis(200);

/// Stops and joins its thread when dropped.
pub(super) struct CameraWatch {
    stop: Option<Sender<()>>,
    thread: Option<JoinHandle<()>>,
}

impl CameraWatch {
    pub fn start(service: &str) -> Result<Self, InputError> {
        // A node of its own: the one of the input belongs to the tracking thread.
        let node = create_node(service)?;
        let frames = open_frames(&node, service, &FrameSlots::DEFAULT)?;
        let (stop, stopped) = mpsc::channel();
        let watch = move || {
            let _node = node;
            while stopped.recv_timeout(LOOK_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                frames.try_cleanup_dead_nodes();
            }
        };
        let thread =
            std::thread::Builder::new().name("camera-watch".to_owned()).spawn(watch).map_err(InputError::Watch)?;
        Ok(Self { stop: Some(stop), thread: Some(thread) })
    }
}

impl Drop for CameraWatch {
    fn drop(&mut self) {
        // The closed channel ends the loop.
        drop(self.stop.take());
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            log::warn!("the thread that watches the camera process panicked");
        }
    }
}
