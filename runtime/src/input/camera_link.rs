//! What is to be done for the camera processes without the tracking thread: acknowledge frames, and clear away
//! processes that were killed.
//!
//! Both allocate (iceoryx2 takes two small blocks per message it publishes, and reads directories to find the dead),
//! so they have a thread of their own. The tracking thread hands over a number and goes on.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use iceoryx2::port::{notifier::Notifier, publisher::Publisher};
use iceoryx2::prelude::PortFactory;
use kilogs_camera::ipc::{
    self, Ack, FrameService, FrameSlots, Ipc, IpcError, IpcNode, ack_name, create_node, open_frames,
};

use super::InputError;

/// A camera that is killed is noticed within this and a little more.
const LOOK_INTERVAL: Duration = Duration::from_millis(200);

/// Stops and joins its thread when dropped, after the last acknowledgement was sent.
pub(super) struct CameraLink {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

#[derive(Default)]
struct Shared {
    /// One more than the sequence number to acknowledge next; 0 when there is none. A later one covers those before.
    pending: AtomicU64,
    n_failures: AtomicU64,
    is_stopping: AtomicBool,
}

impl CameraLink {
    pub fn start(service: &str) -> Result<Self, InputError> {
        let worker = Worker::open(service)?;
        let shared = Arc::new(Shared::default());
        let of_thread = Arc::clone(&shared);
        let thread = std::thread::Builder::new()
            .name("camera-link".to_owned())
            .spawn(move || worker.run(&of_thread))
            .map_err(InputError::Thread)?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Tells the camera that this frame is done with. Does not allocate and does not wait.
    pub fn acknowledge(&self, sequence: u64) {
        self.shared.pending.store(sequence.wrapping_add(1), Ordering::Release);
        self.wake();
    }

    /// Acknowledgements that could not be sent.
    pub fn n_failures(&self) -> u64 {
        self.shared.n_failures.load(Ordering::Relaxed)
    }

    fn wake(&self) {
        if let Some(thread) = &self.thread {
            thread.thread().unpark();
        }
    }
}

impl Drop for CameraLink {
    fn drop(&mut self) {
        self.shared.is_stopping.store(true, Ordering::Release);
        self.wake();
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            log::warn!("the thread that acknowledges frames panicked");
        }
    }
}

/// What the thread works with.
struct Worker {
    frames: FrameService,
    ack_publisher: Publisher<Ipc, Ack, ()>,
    wake_camera: Notifier<Ipc>,
    _node: IpcNode,
}

impl Worker {
    fn open(service: &str) -> Result<Self, IpcError> {
        let advice = "another tracker may be attached already: end it, or choose another --service";
        let failed = |e: &dyn std::fmt::Debug| IpcError::new("attaching to", service, e, advice);
        // A node of its own: the one of the input belongs to the tracking thread.
        let node = create_node(service)?;
        let frames = open_frames(&node, service, &FrameSlots::DEFAULT)?;
        let ack_events = ipc::open_events(&node, &ack_name(service))?;
        let acks = ipc::open_acks(&node, service)?;
        let ack_publisher = acks.publisher_builder().create().map_err(|e| failed(&e))?;
        // Last, because it wakes a waiting camera, which then sends.
        let wake_camera = ack_events.notifier_builder().create().map_err(|e| failed(&e))?;
        Ok(Self { frames, ack_publisher, wake_camera, _node: node })
    }

    fn run(self, shared: &Shared) {
        let mut looked = Instant::now();
        loop {
            let is_stopping = shared.is_stopping.load(Ordering::Acquire);
            let pending = shared.pending.swap(0, Ordering::AcqRel);
            if let Some(sequence) = pending.checked_sub(1) {
                let is_sent = self.ack_publisher.send_copy(Ack { sequence }).is_ok();
                if !(is_sent && self.wake_camera.notify().is_ok()) {
                    shared.n_failures.fetch_add(1, Ordering::Relaxed);
                }
            }
            if is_stopping {
                return;
            }
            if looked.elapsed() >= LOOK_INTERVAL {
                self.frames.try_cleanup_dead_nodes();
                looked = Instant::now();
            }
            std::thread::park_timeout(LOOK_INTERVAL);
        }
    }
}
