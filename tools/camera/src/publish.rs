//! Publishes the frames of a source, in lock-step with the tracker or at the pace of a live camera.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::port::{listener::Listener, notifier::Notifier, publisher::Publisher, subscriber::Subscriber};
use iceoryx2::prelude::*;
use iceoryx2::sample_mut::SampleMut;
use zerocopy::IntoBytes;

use crate::ipc::{
    self, Ack, AckService, FrameHeader, FramePage, FrameService, FrameSlots, Ipc, IpcError, IpcNode, Speed, ack_name,
    frames_name,
};
use crate::source::{FrameInfo, FrameSource, SourceError};

/// How often a waiting camera looks whether it was told to stop, and whether the tracker still lives.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// How long the end of the stream waits to be acknowledged, so that the tracker can read it before the memory goes.
const END_PATIENCE: Duration = Duration::from_secs(2);

/// Speed readings older than this when their frame is sent are nobody's business.
const SPEED_MEMORY_NS: u64 = 5_000_000_000;

/// When the next frame is sent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Pace {
    /// When the tracker is done with the one before. A tracker that dies ends the run.
    LockStep,
    /// At the recorded times, `rate` times as fast. Nobody needs to listen.
    Live {
        /// 1 is real time.
        rate: f64,
    },
}

/// How a source is published.
#[derive(Clone, Debug, PartialEq)]
pub struct PublishSettings {
    /// Service name without `/frames`.
    pub service: String,
    /// When the next frame is sent.
    pub pace: Pace,
    /// How long to wait for a tracker before the first frame; `None` does not wait and goes on without one.
    pub tracker_patience: Option<Duration>,
    /// Whether a live run ends when its tracker does; one in lock-step always does.
    pub ends_with_tracker: bool,
    /// Slots, where the tracker has not created the service before.
    pub slots: FrameSlots,
    /// Which camera of the vehicle.
    pub camera_id: u32,
}

/// What was published.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PublishReport {
    /// Frames sent.
    pub n_sent: u64,
    /// Frames that could not be read; their sequence numbers are missing from the stream.
    pub n_unreadable: u64,
    /// Whether the run was stopped before its end.
    pub is_interrupted: bool,
}

/// Why publishing ended early.
#[derive(Debug, thiserror::Error)]
pub enum PublishError {
    /// The communication broke down.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// Nobody came.
    #[error(
        "waiting for a tracker at \"{service}\": none within {waited_s:.1} s; start `kilogs run --service {service}`, \
         or publish with --live"
    )]
    NoTracker {
        /// Service name.
        service: String,
        /// How long it was waited for.
        waited_s: f64,
    },
    /// The tracker ended or was killed.
    #[error("publishing frame {sequence} at \"{service}\": the tracker is gone; start both anew")]
    TrackerGone {
        /// Service name.
        service: String,
        /// The frame that was not taken.
        sequence: u64,
    },
    /// No frame at all could be read.
    #[error("none of {n_unreadable} frames could be read; the last: {last}")]
    NothingReadable {
        /// How many were tried.
        n_unreadable: u64,
        /// Why the last one failed.
        last: SourceError,
    },
}

/// Publishes `source` to its end, or until `stop` is set. `progress` is told the sequence number of each frame.
///
/// # Errors
/// [`PublishError`]; frames that cannot be read are logged, counted and left out instead.
pub fn publish(
    source: &mut dyn FrameSource,
    settings: &PublishSettings,
    stop: &AtomicBool,
    progress: &mut dyn FnMut(u64),
) -> Result<PublishReport, PublishError> {
    let mut outlet = Outlet::open(source, settings)?;
    let mut report = PublishReport::default();
    if !outlet.wait_for_tracker(settings, stop)? {
        return Ok(PublishReport { is_interrupted: true, ..report });
    }
    let mut clock = LiveClock::default();
    let mut last_problem = None;
    let mut sequence = 0;
    while !stop.load(Ordering::Relaxed) {
        // The next frame is read while the tracker works on the one before.
        let mut sample = outlet.loan()?;
        let frame = match source.next_frame(&mut sample.payload_mut().as_mut_bytes()[..outlet.frame_bytes]) {
            Ok(None) => break,
            Ok(Some(frame)) => frame,
            Err(problem) => {
                log::warn!("{problem}");
                (report.n_unreadable, last_problem) = (report.n_unreadable + 1, Some(problem));
                sequence += 1;
                continue;
            }
        };
        let goes_on = match settings.pace {
            Pace::LockStep => outlet.wait_for_last_ack(stop)?,
            Pace::Live { rate } => clock.wait_until(frame.timestamp_ns, rate, stop),
        };
        if settings.ends_with_tracker && !outlet.has_tracker() {
            return Err(PublishError::TrackerGone { service: settings.service.clone(), sequence });
        }
        if !goes_on {
            break;
        }
        // Before their frame, so that whoever has the frame has them.
        while let Some(reading) = source.next_speed(frame.timestamp_ns) {
            outlet.send_speed(reading, frame.timestamp_ns)?;
        }
        outlet.send(sample, sequence, frame, settings.pace)?;
        progress(sequence);
        report.n_sent += 1;
        sequence += 1;
    }
    report.is_interrupted = stop.load(Ordering::Relaxed);
    if settings.pace == Pace::LockStep {
        outlet.wait_for_last_ack(stop)?;
    }
    outlet.end(sequence)?;
    match last_problem {
        Some(last) if report.n_sent == 0 => {
            Err(PublishError::NothingReadable { n_unreadable: report.n_unreadable, last })
        }
        _ => Ok(report),
    }
}

type FrameSample = SampleMut<Ipc, [FramePage], FrameHeader>;

/// The ports of one camera.
struct Outlet {
    service: String,
    header: FrameHeader,
    frame_bytes: usize,
    frames: FrameService,
    publisher: Publisher<Ipc, [FramePage], FrameHeader>,
    wake_tracker: Notifier<Ipc>,
    acks: AckService,
    ack_subscriber: Subscriber<Ipc, Ack, ()>,
    ack_listener: Listener<Ipc>,
    /// Opened with the first reading: most sources have none.
    speeds: Option<Publisher<Ipc, Speed, ()>>,
    last_sent: Option<FrameInfo>,
    last_sent_sequence: Option<u64>,
    last_acked: Option<u64>,
    looked: Instant,
    // Must outlive the ports.
    node: IpcNode,
}

impl Outlet {
    fn open(source: &dyn FrameSource, settings: &PublishSettings) -> Result<Self, IpcError> {
        let service = settings.service.as_str();
        let advice = "two cameras may run under this name already: end them, or choose another --service";
        let failed = |e: &dyn std::fmt::Debug| IpcError::new("publishing at", service, e, advice);
        let node = ipc::create_node(service)?;
        let frames = ipc::open_frames(&node, service, &settings.slots)?;
        let acks = ipc::open_acks(&node, service)?;
        let format = source.format();
        let size = [format.camera.width, format.camera.height];
        let publisher = frames
            .publisher_builder()
            .initial_max_slice_len(FramePage::needed_for(format.frame_bytes()))
            .max_loaned_samples(1)
            .create()
            .map_err(|e| failed(&e))?;
        let ack_subscriber = acks.subscriber_builder().create().map_err(|e| failed(&e))?;
        let ack_events = ipc::open_events(&node, &ack_name(service))?;
        let ack_listener = ack_events.listener_builder().create().map_err(|e| failed(&e))?;
        // Last, because it wakes the tracker, which then looks for the publisher.
        let frame_events = ipc::open_events(&node, &frames_name(service))?;
        let wake_tracker = frame_events.notifier_builder().create().map_err(|e| failed(&e))?;
        let header = FrameHeader::packed(0, 0, size, format.pixel_format);
        Ok(Self {
            service: service.to_owned(),
            header: FrameHeader { camera_id: settings.camera_id, ..header },
            frame_bytes: format.frame_bytes() as usize,
            frames,
            publisher,
            wake_tracker,
            acks,
            ack_subscriber,
            ack_listener,
            speeds: None,
            last_sent: None,
            last_sent_sequence: None,
            last_acked: None,
            looked: Instant::now(),
            node,
        })
    }

    /// `false` when told to stop.
    fn wait_for_tracker(&mut self, settings: &PublishSettings, stop: &AtomicBool) -> Result<bool, PublishError> {
        let Some(patience) = settings.tracker_patience else { return Ok(true) };
        let started = Instant::now();
        while !self.has_tracker() {
            if stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            if started.elapsed() >= patience {
                let service = self.service.clone();
                return Err(PublishError::NoTracker { service, waited_s: patience.as_secs_f64() });
            }
            self.sleep_until_event(LOOK_INTERVAL.min(patience));
        }
        Ok(true)
    }

    fn loan(&self) -> Result<FrameSample, IpcError> {
        self.publisher
            .loan_slice(FramePage::needed_for(self.frame_bytes as u64))
            .map_err(|e| self.broken("taking a frame slot of", e))
    }

    fn send(&mut self, sample: FrameSample, sequence: u64, frame: FrameInfo, pace: Pace) -> Result<(), IpcError> {
        let header =
            FrameHeader { sequence, timestamp_ns: frame.timestamp_ns, exposure_us: frame.exposure_us, ..self.header };
        self.last_sent = Some(frame);
        match (self.send_with(sample, header), pace) {
            // A live camera goes on when a reader dies while it is being connected to.
            (Err(problem), Pace::Live { .. }) => {
                log::warn!("{problem}");
                Ok(())
            }
            (result, _) => result,
        }
    }

    fn send_with(&mut self, mut sample: FrameSample, header: FrameHeader) -> Result<(), IpcError> {
        *sample.user_header_mut() = header;
        sample.send().map_err(|e| self.broken("sending a frame at", e))?;
        self.last_sent_sequence = Some(header.sequence);
        self.wake_tracker.notify().map_err(|e| self.broken("waking the tracker at", e))?;
        Ok(())
    }

    fn send_speed(&mut self, reading: Speed, frame_ns: u64) -> Result<(), IpcError> {
        if reading.timestamp_ns.saturating_add(SPEED_MEMORY_NS) < frame_ns {
            return Ok(());
        }
        let speeds = match self.speeds.take() {
            Some(speeds) => speeds,
            None => ipc::open_speeds(&self.node, &self.service)?
                .publisher_builder()
                .create()
                .map_err(|e| self.broken("publishing the speed at", e))?,
        };
        let is_sent = speeds.send_copy(reading);
        self.speeds = Some(speeds);
        is_sent.map(|_| ()).map_err(|e| self.broken("sending a speed at", e))
    }

    /// Waits until the frame sent last is acknowledged; `false` when told to stop.
    fn wait_for_last_ack(&mut self, stop: &AtomicBool) -> Result<bool, PublishError> {
        while self.is_ack_due()? {
            if stop.load(Ordering::Relaxed) {
                return Ok(false);
            }
            if !self.has_tracker() {
                let sequence = self.last_sent_sequence.unwrap_or(0);
                return Err(PublishError::TrackerGone { service: self.service.clone(), sequence });
            }
            self.sleep_until_event(LOOK_INTERVAL);
        }
        Ok(true)
    }

    /// Says that no frame follows, and leaves the tracker time to read it.
    fn end(&mut self, sequence: u64) -> Result<(), IpcError> {
        let timestamp_ns = self.last_sent.map_or(0, |frame| frame.timestamp_ns);
        let sample = self.publisher.loan_slice(1).map_err(|e| self.broken("taking a frame slot of", e))?;
        self.send_with(sample, FrameHeader::end_of_stream(sequence, timestamp_ns))?;
        let ended = Instant::now();
        while self.has_tracker() && self.is_ack_due()? && ended.elapsed() < END_PATIENCE {
            self.sleep_until_event(LOOK_INTERVAL);
        }
        Ok(())
    }

    fn is_ack_due(&mut self) -> Result<bool, IpcError> {
        while let Some(ack) =
            self.ack_subscriber.receive().map_err(|e| self.broken("reading acknowledgements at", e))?
        {
            self.last_acked = Some(ack.sequence);
        }
        // Equality, not order: a late word for a camera process before this one must not pass for our own.
        Ok(self.last_acked != self.last_sent_sequence)
    }

    /// Whether someone acknowledges. A tracker that was killed is cleared away here.
    fn has_tracker(&mut self) -> bool {
        if self.looked.elapsed() >= LOOK_INTERVAL {
            self.frames.try_cleanup_dead_nodes();
            self.looked = Instant::now();
        }
        self.acks.dynamic_config().number_of_publishers() > 0
    }

    fn sleep_until_event(&self, at_most: Duration) {
        // An interrupted wait is a reason to look again, as an event is.
        if self.ack_listener.timed_wait(|_| (), at_most).is_err() {
            std::thread::yield_now();
        }
    }

    fn broken(&self, doing: &'static str, reason: impl std::fmt::Debug) -> IpcError {
        IpcError::new(doing, &self.service, reason, "check the space in /dev/shm and start both processes anew")
    }
}

/// When frames of a recording are due.
#[derive(Default)]
struct LiveClock {
    start: Option<(Instant, u64)>,
}

impl LiveClock {
    /// `false` when told to stop.
    fn wait_until(&mut self, timestamp_ns: u64, rate: f64, stop: &AtomicBool) -> bool {
        let (started, first_ns) = *self.start.get_or_insert((Instant::now(), timestamp_ns));
        let due = Duration::from_nanos(((timestamp_ns - first_ns) as f64 / rate) as u64);
        loop {
            if stop.load(Ordering::Relaxed) {
                return false;
            }
            match due.checked_sub(started.elapsed()) {
                Some(left) if !left.is_zero() => std::thread::sleep(left.min(LOOK_INTERVAL)),
                _ => return true,
            }
        }
    }
}
