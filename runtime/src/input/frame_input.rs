//! Frames out of the camera service, borrowed where the camera process wrote them.

use std::time::{Duration, Instant};

use iceoryx2::identifiers::UniquePublisherId;
use iceoryx2::port::{ReceiveError, listener::Listener, subscriber::Subscriber};
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use kilogs_camera::ipc::{
    self, FrameHeader, FramePage, FrameService, FrameSlots, HeaderVerdict, Ipc, IpcError, IpcNode, PreviousFrame,
    ServiceFormat, frames_name,
};
use kilogs_core::conventions::TimestampNs;
use kilogs_core::frame::PixelFormat;
use zerocopy::IntoBytes;

use super::camera_link::CameraLink;
use super::session::{Judgement, Session};
use super::speed_input::SpeedInput;
use super::{BorrowedFrame, CameraState, InputCounts, InputError};
use crate::seal;

/// A waiting input looks at least this often whether the camera is there, should an event have been lost.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);

/// What a frame input listens to.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InputSettings {
    /// Service name without `/frames`.
    pub service: String,
    /// What every frame must look like.
    pub format: ServiceFormat,
    /// Slots, where the camera has not created the service before.
    pub slots: FrameSlots,
    /// Times are those of a recording: a long pause in them is a pause, and no clock that was set.
    pub is_recorded: bool,
    /// Speed readings of the vehicle that are kept.
    pub speed_readings: usize,
}

/// What came of waiting.
#[derive(Debug)]
pub enum InputEvent<'input> {
    /// A frame; it is acknowledged and given back when dropped.
    Frame(BorrowedFrame<'input>),
    /// This message cannot be used. It was counted and acknowledged.
    Refused(HeaderVerdict),
    /// A camera process is there; its frames follow.
    CameraCame {
        /// Whether none came before it.
        is_first: bool,
    },
    /// The camera process died or left without ending the stream. Another one may come.
    CameraGone {
        /// How long ago its last frame arrived.
        silent_for: Duration,
    },
    /// The stream is complete.
    End,
    /// Nothing happened.
    Timeout {
        /// How the camera process is.
        camera: CameraState,
        /// How long ago its last frame arrived.
        silent_for: Duration,
    },
}

/// The tracker's end of a camera service.
///
/// One thread waits at a time. After its first frames, [`FrameInput::wait`] and the frames it lends do not allocate.
pub struct FrameInput {
    service: String,
    format: ServiceFormat,
    is_recorded: bool,
    state: CameraState,
    counts: InputCounts,
    session: Option<Session>,
    /// The first message of the next camera process, until it was told that the one before is gone.
    held: Option<Sample<Ipc, [FramePage], FrameHeader>>,
    /// Camera processes at the last look. Reading their number is free; asking who they are allocates.
    n_cameras: usize,
    /// Acknowledged with the next wait, so that the camera process outlives the event that tells of its end.
    unacknowledged_end: Option<u64>,
    last_frame: Option<LastFrame>,
    /// Index of the next frame in the run, however often a camera begins to count anew.
    next_index: u64,
    /// A camera process was there before this input.
    was_there_first: bool,
    opened: Instant,
    subscriber: Subscriber<Ipc, [FramePage], FrameHeader>,
    listener: Listener<Ipc>,
    frames: FrameService,
    speeds: SpeedInput,
    link: CameraLink,
    _node: IpcNode,
}

#[derive(Clone, Copy, Debug)]
struct LastFrame {
    timestamp_ns: TimestampNs,
    arrived: Instant,
}

/// What a sample turned out to be.
enum Judged {
    Frame { pixel_format: PixelFormat, timestamp_ns: TimestampNs, frame_index: u64 },
    End,
    Refused(HeaderVerdict),
}

impl FrameInput {
    /// Attaches to the service, or creates it; the camera may come later.
    ///
    /// # Errors
    /// [`InputError`] when the shared memory cannot be used or the name is taken.
    pub fn open(settings: &InputSettings) -> Result<Self, InputError> {
        let service = settings.service.as_str();
        let advice = "another tracker may be attached already: end it, or choose another --service";
        let failed = |e: &dyn std::fmt::Debug| IpcError::new("attaching to", service, e, advice);
        let node = ipc::create_node(service)?;
        let frames = ipc::open_frames(&node, service, &settings.slots)?;
        let frame_events = ipc::open_events(&node, &frames_name(service))?;
        let listener = frame_events.listener_builder().create().map_err(|e| failed(&e))?;
        let subscriber = frames.subscriber_builder().create().map_err(|e| failed(&e))?;
        let was_there_first = frames.dynamic_config().number_of_publishers() > 0;
        let speeds = SpeedInput::open(&node, service, settings.speed_readings)?;
        // Last, because it wakes a waiting camera, which then sends.
        let link = CameraLink::start(service)?;
        Ok(Self {
            service: service.to_owned(),
            format: settings.format,
            is_recorded: settings.is_recorded,
            state: CameraState::NeverCame,
            counts: InputCounts::default(),
            session: None,
            held: None,
            n_cameras: 0,
            unacknowledged_end: None,
            last_frame: None,
            next_index: 0,
            was_there_first,
            opened: Instant::now(),
            subscriber,
            listener,
            frames,
            speeds,
            link,
            _node: node,
        })
    }

    /// Waits for what comes next, at most `timeout`.
    ///
    /// # Errors
    /// [`InputError`] when the shared memory breaks down; frames that cannot be used are events instead.
    pub fn wait(&mut self, timeout: Duration) -> Result<InputEvent<'_>, InputError> {
        let started = Instant::now();
        if let Some(sequence) = self.unacknowledged_end.take() {
            self.link.acknowledge(sequence);
        }
        loop {
            // A camera comes before its first frame and goes after its last.
            if let Some(event) = self.note_coming() {
                return Ok(event);
            }
            if let Some(sample) = self.held.take() {
                return Ok(self.take(sample));
            }
            if let Some(sample) = self.receive()? {
                if self.is_of_successor(&sample) {
                    self.held = Some(sample);
                    return Ok(self.gone());
                }
                return Ok(self.take(sample));
            }
            if let Some(event) = self.note_going() {
                return Ok(event);
            }
            let left = timeout.saturating_sub(started.elapsed());
            if left.is_zero() {
                if self.state == CameraState::Sending {
                    self.state = CameraState::Silent;
                }
                return Ok(InputEvent::Timeout { camera: self.state, silent_for: self.silent_for() });
            }
            // An interrupted wait is a reason to look again, as an event is.
            if self.listener.timed_wait(|_| (), left.min(LOOK_INTERVAL)).is_err() {
                std::thread::yield_now();
            }
        }
    }

    /// How many indices were given to frames that came or are missing.
    pub fn n_frame_indices(&self) -> u64 {
        self.next_index
    }

    /// What came in so far.
    pub fn counts(&self) -> InputCounts {
        InputCounts { n_ack_failures: self.link.n_failures(), ..self.counts }
    }

    /// How the camera process is, as of the last wait.
    pub fn camera_state(&self) -> CameraState {
        self.state
    }

    /// The frame slots of the service as it is; whoever made it decided.
    pub fn slots(&self) -> FrameSlots {
        let settings = self.frames.static_config();
        FrameSlots {
            subscribers: settings.max_subscribers(),
            buffered: settings.subscriber_max_buffer_size(),
            borrowed: settings.subscriber_max_borrowed_samples(),
        }
    }

    fn receive(&mut self) -> Result<Option<Sample<Ipc, [FramePage], FrameHeader>>, IpcError> {
        let advice = "check the space in /dev/shm, and start camera and tracker anew";
        match self.subscriber.receive() {
            Ok(sample) => Ok(sample),
            // A camera process that dies while it is being connected to; the link clears it away.
            Err(ReceiveError::ConnectionFailure(_)) => {
                self.counts.n_connection_failures += 1;
                Ok(None)
            }
            Err(e) => Err(IpcError::new("receiving a frame from", &self.service, e, advice)),
        }
    }

    fn take(&mut self, sample: Sample<Ipc, [FramePage], FrameHeader>) -> InputEvent<'_> {
        let header = *sample.user_header();
        let sent_bytes = sample.payload().as_bytes().len() as u64;
        match self.judge(&header, sample.header().publisher_id(), sent_bytes) {
            Judged::Frame { pixel_format, timestamp_ns, frame_index } => {
                self.speeds.drain(timestamp_ns.wrapping_sub(header.timestamp_ns));
                let (link, speeds) = (&self.link, self.speeds.ring());
                InputEvent::Frame(BorrowedFrame { sample, pixel_format, timestamp_ns, frame_index, link, speeds })
            }
            Judged::End => InputEvent::End,
            Judged::Refused(verdict) => {
                self.counts.n_refused += 1;
                self.link.acknowledge(header.sequence);
                InputEvent::Refused(verdict)
            }
        }
    }

    fn judge(&mut self, header: &FrameHeader, camera: UniquePublisherId, sent_bytes: u64) -> Judged {
        let Some(mut session) = self.session_of(camera) else { return Judged::Refused(HeaderVerdict::SecondCamera) };
        let Judgement { verdict, n_missing, is_new_clock } = session.judge(header, &self.format, sent_bytes);
        let judged = match verdict {
            HeaderVerdict::Accept { pixel_format, .. } => {
                let timestamp_ns = self.continuous_time(&mut session, header.timestamp_ns, is_new_clock);
                self.format.pixel_format = Some(pixel_format);
                self.state = CameraState::Sending;
                self.last_frame = Some(LastFrame { timestamp_ns, arrived: Instant::now() });
                self.counts.n_received += 1;
                let frame_index = self.skip(n_missing);
                self.next_index = frame_index + 1;
                session.previous = Some(PreviousFrame { sequence: header.sequence, timestamp_ns: header.timestamp_ns });
                Judged::Frame { pixel_format, timestamp_ns, frame_index }
            }
            HeaderVerdict::End { .. } => {
                session.has_ended = true;
                self.state = CameraState::Ended;
                self.next_index = self.skip(n_missing);
                self.unacknowledged_end = Some(header.sequence);
                Judged::End
            }
            refusal => Judged::Refused(refusal),
        };
        self.session = Some(session);
        judged
    }

    /// Counts missing frames; the index of the frame behind them.
    fn skip(&mut self, n_missing: u64) -> u64 {
        self.counts.n_missing = self.counts.n_missing.saturating_add(n_missing);
        self.next_index.saturating_add(n_missing)
    }

    /// The session of this camera process; `None` while another one is alive.
    fn session_of(&mut self, camera: UniquePublisherId) -> Option<Session> {
        match self.session {
            Some(mut session) if session.camera == camera => {
                session.has_gone = false;
                Some(session)
            }
            Some(session) if !session.has_ended && self.is_alive(session.camera) => None,
            earlier => {
                self.counts.n_restarts += u32::from(earlier.is_some());
                // Whoever came later had nobody to send to before.
                Some(Session::new(camera, earlier.is_none() && self.was_there_first))
            }
        }
    }

    fn is_alive(&self, camera: UniquePublisherId) -> bool {
        // The list takes memory; it is asked for only when a camera process came or went.
        let _lifted = seal::lift();
        let mut is_alive = false;
        self.frames.dynamic_config().list_publishers(|details| {
            is_alive |= details.publisher_id == camera;
            CallbackProgression::Continue
        });
        is_alive
    }

    /// A camera process that starts anew may start its clock anew, and a clock may be set: times then go on after the
    /// last one, by the time that passed here. The times of a recording stay as they are while they go on.
    fn continuous_time(&self, session: &mut Session, timestamp_ns: TimestampNs, is_new_clock: bool) -> TimestampNs {
        let is_anew = is_new_clock || session.previous.is_none();
        let is_set = is_new_clock && !self.is_recorded;
        if let Some(last) = self.last_frame
            && (is_set || (is_anew && timestamp_ns <= last.timestamp_ns))
        {
            let passed_ns = last.arrived.elapsed().as_nanos().max(1) as u64;
            session.time_shift_ns = last.timestamp_ns.saturating_add(passed_ns).wrapping_sub(timestamp_ns);
        }
        timestamp_ns.wrapping_add(session.time_shift_ns)
    }

    fn note_coming(&mut self) -> Option<InputEvent<'static>> {
        let n_cameras = self.frames.dynamic_config().number_of_publishers();
        if n_cameras == 0 || !matches!(self.state, CameraState::NeverCame | CameraState::Gone) {
            return None;
        }
        (self.state, self.n_cameras) = (CameraState::Silent, n_cameras);
        Some(InputEvent::CameraCame { is_first: self.session.is_none() })
    }

    fn note_going(&mut self) -> Option<InputEvent<'static>> {
        let n_cameras = self.frames.dynamic_config().number_of_publishers();
        let is_unchanged = n_cameras > 0 && n_cameras == self.n_cameras;
        if is_unchanged || !matches!(self.state, CameraState::Sending | CameraState::Silent) {
            return None;
        }
        self.n_cameras = n_cameras;
        let is_there = match self.session {
            Some(session) if self.state == CameraState::Sending => self.is_alive(session.camera),
            _ => n_cameras > 0,
        };
        if is_there {
            return None;
        }
        Some(self.gone())
    }

    fn gone(&mut self) -> InputEvent<'static> {
        self.state = CameraState::Gone;
        if let Some(session) = &mut self.session {
            session.has_gone = true;
        }
        InputEvent::CameraGone { silent_for: self.silent_for() }
    }

    /// Whether another camera process than that of the session sends, which nobody has seen going.
    fn is_of_successor(&self, sample: &Sample<Ipc, [FramePage], FrameHeader>) -> bool {
        let camera = sample.header().publisher_id();
        let before = self.session.filter(|before| before.camera != camera && !before.has_ended && !before.has_gone);
        before.is_some_and(|before| !self.is_alive(before.camera))
    }

    fn silent_for(&self) -> Duration {
        self.last_frame.map_or(self.opened, |frame| frame.arrived).elapsed()
    }
}

impl Drop for FrameInput {
    fn drop(&mut self) {
        if let Some(sequence) = self.unacknowledged_end.take() {
            self.link.acknowledge(sequence);
        }
    }
}
