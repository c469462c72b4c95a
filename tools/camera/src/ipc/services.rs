//! Opening the services, with the same settings on both sides.

use std::fmt::Debug;
use std::sync::Once;
use std::time::{SystemTime, UNIX_EPOCH};

use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{event, publish_subscribe};

use super::{Ack, FrameHeader, FramePage, PAGE_BYTES, Speed};

/// The kind of iceoryx2 service everything here uses: ports may move between threads.
pub type Ipc = ipc_threadsafe::Service;

/// A process's membership in the communication.
pub type IpcNode = Node<Ipc>;

/// `<service>/frames`.
pub type FrameService = publish_subscribe::PortFactory<Ipc, [FramePage], FrameHeader>;

/// `<service>/ack`.
pub type AckService = publish_subscribe::PortFactory<Ipc, Ack, ()>;

/// What wakes the other side.
pub type EventService = event::PortFactory<Ipc>;

/// Where the odometry is published.
pub const ODOMETRY_SERVICE: &str = "kilogs/odometry";

/// Where the health is published.
pub const HEALTH_SERVICE: &str = "kilogs/health";

/// A restarted camera must find a place before its dead predecessor is cleared away.
const MAX_CAMERAS: usize = 2;

/// Processes at a frame service: cameras, trackers, their watchers, and someone who looks on.
const MAX_NODES: usize = 16;

/// Processes that publish odometry or health at once, and that listen to one.
const MAX_MESSAGE_PORTS: usize = 32;

/// Small messages that wait for a slow reader.
const MESSAGE_BUFFER: usize = 4;

/// Speed readings that wait for a frame: five seconds at 100 Hz.
const SPEED_BUFFER: usize = 512;

/// How many frames the shared memory holds; decided by whoever creates the service.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameSlots {
    /// Processes that can read at once.
    pub subscribers: usize,
    /// Newest frames that wait for a reader; the oldest is overwritten.
    pub buffered: usize,
    /// Frames that a reader can hold.
    pub borrowed: usize,
}

impl FrameSlots {
    /// One tracker and one more reader, two frames waiting, one in work and one in reserve: nine slots.
    pub const DEFAULT: Self = Self { subscribers: 2, buffered: 2, borrowed: 2 };

    /// Frames that the camera writes at once.
    const LOANED: usize = 1;

    /// The best division of `n_slots`, `None` where they do not suffice for one tracker.
    pub const fn within(n_slots: usize) -> Option<Self> {
        let Some(for_readers) = n_slots.checked_sub(Self::LOANED) else { return None };
        match for_readers {
            0..2 => None,
            2..4 => Some(Self { subscribers: 1, buffered: for_readers - 1, borrowed: 1 }),
            4..8 => Some(Self { subscribers: 1, buffered: for_readers - 2, borrowed: 2 }),
            _ => Some(Self { subscribers: 2, buffered: for_readers / 2 - 2, borrowed: 2 }),
        }
    }

    /// Slots in all, as iceoryx2 reserves them per camera process.
    pub const fn n_slots(&self) -> usize {
        self.subscribers * (self.buffered + self.borrowed) + Self::LOANED
    }

    /// Pages per slot for iceoryx2's and our header, which stand before the page-aligned pixels.
    const HEADER_PAGES: usize = 1;

    /// Pages per camera process in which iceoryx2 keeps account of the slots (measured, the same for all sizes).
    const ACCOUNT_PAGES: usize = 2;

    /// Shared memory that frames of `packed_bytes` take, per camera process.
    pub const fn shared_bytes(&self, packed_bytes: u64) -> u64 {
        let pages_per_slot = FramePage::needed_for(packed_bytes) + Self::HEADER_PAGES;
        ((self.n_slots() * pages_per_slot + Self::ACCOUNT_PAGES) * PAGE_BYTES) as u64
    }
}

/// The communication could not be set up or broke down.
#[derive(Debug, thiserror::Error)]
#[error("{doing} \"{service}\": {reason}; {advice}")]
pub struct IpcError {
    /// What was being done.
    pub doing: &'static str,
    /// To which service.
    pub service: String,
    /// What iceoryx2 answered.
    pub reason: String,
    /// What to try.
    pub advice: &'static str,
}

impl IpcError {
    /// Wraps an answer of iceoryx2.
    pub fn new(doing: &'static str, service: &str, reason: impl Debug, advice: &'static str) -> Self {
        Self { doing, service: service.to_owned(), reason: format!("{reason:?}"), advice }
    }
}

const ADVICE_DIRECTORIES: &str =
    "check that /dev/shm and /tmp/iceoryx2 can be written and have space (`kilogs doctor` does)";
const ADVICE_SERVICE: &str =
    "a program with other settings, or of another version, uses the name: end it, or give --service where there is one";

const ADVICE_NAME: &str = "use letters, digits, '/', '-', '_' and '.', at most 200 characters";

/// Longest name of a camera's service; iceoryx2 holds a little more, for what is appended.
const MAX_SERVICE_BYTES: usize = 200;

/// Joins the communication; clears away what crashed processes left behind. Signals stay with the program.
///
/// # Errors
/// [`IpcError`] when the shared directories cannot be used.
pub fn create_node(service: &str) -> Result<IpcNode, IpcError> {
    static LOG_LEVEL: Once = Once::new();
    LOG_LEVEL.call_once(|| set_log_level_from_env_or(LogLevel::Error));
    let node = NodeBuilder::new().signal_handling_mode(SignalHandlingMode::Disabled).create::<Ipc>();
    let node = node.map_err(|e| IpcError::new("joining the communication for", service, e, ADVICE_DIRECTORIES))?;
    node.try_cleanup_dead_nodes();
    Ok(node)
}

/// Opens `<service>/frames`, or creates it with `slots`; the slots of a service that is there already stay.
///
/// # Errors
/// [`IpcError`] when the name is taken by something else or the shared memory cannot be used.
pub fn open_frames(node: &IpcNode, service: &str, slots: &FrameSlots) -> Result<FrameService, IpcError> {
    let name = frames_name(service);
    let builder = || {
        let builder = node.service_builder(&checked(&name)?).publish_subscribe::<[FramePage]>();
        Ok(builder.user_header::<FrameHeader>())
    };
    if let Ok(there) = builder()?.open() {
        return Ok(there);
    }
    let created = builder()?
        .max_publishers(MAX_CAMERAS)
        .max_nodes(MAX_NODES)
        .max_subscribers(slots.subscribers)
        .subscriber_max_buffer_size(slots.buffered)
        .subscriber_max_borrowed_samples(slots.borrowed)
        .history_size(0)
        .enable_safe_overflow(true)
        .create();
    match created {
        Ok(created) => Ok(created),
        // The other side may have created it between our two attempts.
        Err(_) => builder()?.open().map_err(|e| IpcError::new("opening the frames of", &name, e, ADVICE_SERVICE)),
    }
}

/// Opens or creates `<service>/ack`.
///
/// # Errors
/// [`IpcError`] when the name is taken by something else.
pub fn open_acks(node: &IpcNode, service: &str) -> Result<AckService, IpcError> {
    let name = ack_name(service);
    node.service_builder(&checked(&name)?)
        .publish_subscribe::<Ack>()
        .max_publishers(MAX_CAMERAS)
        .max_subscribers(MAX_CAMERAS)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(MESSAGE_BUFFER)
        .history_size(0)
        .enable_safe_overflow(true)
        .open_or_create()
        .map_err(|e| IpcError::new("opening the acknowledgements of", &name, e, ADVICE_SERVICE))
}

/// Opens or creates `<service>/speed`.
///
/// # Errors
/// [`IpcError`] when the name is taken by something else.
pub fn open_speeds(node: &IpcNode, service: &str) -> Result<publish_subscribe::PortFactory<Ipc, Speed, ()>, IpcError> {
    let name = speed_name(service);
    node.service_builder(&checked(&name)?)
        .publish_subscribe::<Speed>()
        .max_publishers(MAX_CAMERAS)
        .max_subscribers(MAX_CAMERAS)
        .max_nodes(MAX_NODES)
        .subscriber_max_buffer_size(SPEED_BUFFER)
        .history_size(0)
        .enable_safe_overflow(true)
        .open_or_create()
        .map_err(|e| IpcError::new("opening the speed of", &name, e, ADVICE_SERVICE))
}

/// Opens or creates the event service that wakes the readers of `name`. A notifier that comes, goes or dies wakes them too.
///
/// # Errors
/// [`IpcError`] when the name is taken by something else.
pub fn open_events(node: &IpcNode, name: &str) -> Result<EventService, IpcError> {
    let wake = EventId::new(0);
    node.service_builder(&checked(name)?)
        .event()
        .max_notifiers(MAX_NODES)
        .max_listeners(MAX_NODES)
        .max_nodes(MAX_NODES)
        .notifier_created_event(wake)
        .notifier_dropped_event(wake)
        .notifier_dead_event(wake)
        .open_or_create()
        .map_err(|e| IpcError::new("opening the events of", name, e, ADVICE_SERVICE))
}

/// Opens or creates a service of small messages.
///
/// # Errors
/// [`IpcError`] when the name is taken by something else.
pub fn open_messages<Message: Debug + ZeroCopySend + 'static>(
    node: &IpcNode,
    name: &str,
) -> Result<publish_subscribe::PortFactory<Ipc, Message, ()>, IpcError> {
    node.service_builder(&checked(name)?)
        .publish_subscribe::<Message>()
        .max_publishers(MAX_MESSAGE_PORTS)
        .max_subscribers(MAX_MESSAGE_PORTS)
        .max_nodes(MAX_MESSAGE_PORTS)
        .subscriber_max_buffer_size(MESSAGE_BUFFER)
        .history_size(0)
        .enable_safe_overflow(true)
        .open_or_create()
        .map_err(|e| IpcError::new("opening", name, e, ADVICE_SERVICE))
}

/// Name of the frame service.
pub fn frames_name(service: &str) -> String {
    format!("{service}/frames")
}

/// Name of the acknowledgement service.
pub fn ack_name(service: &str) -> String {
    format!("{service}/ack")
}

/// Name of the speed service.
pub fn speed_name(service: &str) -> String {
    format!("{service}/speed")
}

/// A service name that no other run on this machine uses.
pub fn unique_service_name(purpose: &str) -> String {
    let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    format!("kilogs/{purpose}-{}-{:x}", std::process::id(), since_epoch.as_nanos())
}

/// The name of a camera's service as typed: a name of other characters would never meet its other side.
///
/// # Errors
/// What to type instead.
pub fn parse_service(text: &str) -> Result<String, String> {
    let is_known = |c: char| c.is_ascii_alphanumeric() || matches!(c, '/' | '-' | '_' | '.');
    if text.is_empty() || text.len() > MAX_SERVICE_BYTES || !text.chars().all(is_known) {
        return Err(ADVICE_NAME.to_owned());
    }
    Ok(text.to_owned())
}

fn checked(name: &str) -> Result<ServiceName, IpcError> {
    ServiceName::new(name).map_err(|e| IpcError::new("naming the service", name, e, ADVICE_NAME))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nine_slots_hold_kitti_in_the_planned_memory() {
        assert_eq!(FrameSlots::DEFAULT.n_slots(), 9);
        // The sizes of the mappings that iceoryx2 made for these images.
        assert_eq!(FrameSlots::DEFAULT.shared_bytes(1226 * 370), 4_136_960);
        assert_eq!(FrameSlots::DEFAULT.shared_bytes(1242 * 375 * 3), 12_652_544);
        assert_eq!(FrameSlots::DEFAULT.shared_bytes(416 * 128 * 3), 1_482_752);
    }

    #[test]
    fn slots_are_divided_without_exceeding_them() {
        let check = |n_slots, expected: Option<[usize; 3]>| {
            let found = FrameSlots::within(n_slots);
            assert_eq!(found.map(|slots| [slots.subscribers, slots.buffered, slots.borrowed]), expected, "{n_slots}");
            assert!(found.is_none_or(|slots| slots.n_slots() <= n_slots));
        };
        check(0, None);
        check(2, None);
        check(3, Some([1, 1, 1]));
        check(4, Some([1, 2, 1]));
        check(5, Some([1, 2, 2]));
        check(8, Some([1, 5, 2]));
        check(9, Some([2, 2, 2]));
        check(10, Some([2, 2, 2]));
        check(64, Some([2, 29, 2]));
        assert_eq!(FrameSlots::within(FrameSlots::DEFAULT.n_slots()), Some(FrameSlots::DEFAULT));
    }

    #[test]
    fn names_of_two_runs_differ() {
        assert_ne!(unique_service_name("test"), unique_service_name("test"));
    }

    #[test]
    fn a_typed_name_is_taken_only_where_both_sides_can_meet() {
        let longest = "x".repeat(MAX_SERVICE_BYTES);
        for (name, is_good) in [("front", true), ("kilogs/a-1_b", true), (longest.as_str(), true)].into_iter().chain([
            ("", false),
            ("bad name!", false),
            ("caméra", false),
            (&*[&longest, "x"].concat(), false),
        ]) {
            assert_eq!(parse_service(name).is_ok(), is_good, "{name}");
        }
    }

    #[test]
    fn a_name_that_cannot_be_says_what_to_do() {
        let text = checked("").map(|_| ()).map_err(|e| e.to_string());
        assert!(text.as_ref().is_err_and(|t| t.contains("letters")), "{text:?}");
    }
}
