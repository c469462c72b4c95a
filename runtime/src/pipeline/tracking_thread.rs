//! The tracking thread: from the shared memory to a pose, every frame, without taking memory.

use super::camera_image::CameraImage;
use super::given_poses::GivenPoses;
use super::loops::LoopLink;
use super::mapper_link::MapperLink;
use super::matchers::Matchers;
use super::plan::RunPlan;
use super::queue::Sender;
use super::record::Record;
use crate::budget::{Row, Usage};
use crate::input::{BorrowedFrame, FrameInput, HeaderVerdict, InputEvent};
use crate::map_store::HeldOutRule;
use crate::output::{Stage, StageTimes};
use crate::run_error::RunError;
use crate::seal;
use kilogs_core::conventions::TimestampNs;
use kilogs_core::frame::ImageView;
use kilogs_core::tracking::{FrameReport, FrameStatus, Tracker, Travelled};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// How long the thread waits before it looks whether it was told to stop.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);
/// Frames of a camera process after which nothing is set up any more and the thread is sealed.
const WARM_UP_FRAMES: u64 = 3;

/// Everything that the thread owns.
pub struct TrackingThread<'run> {
    /// What the run does.
    pub plan: &'run RunPlan,
    /// The calculator, on memory taken at the start.
    pub tracker: Tracker<'static>,
    /// What it asks when tracks break.
    pub matchers: Matchers,
    /// Where keyframes go.
    pub mapper: Option<MapperLink>,
    /// Where keyframes go to be recognized.
    pub loops: Option<LoopLink>,
    /// Where records go.
    pub records: Sender<Record>,
    /// Where poses go to be published.
    pub odometry: Sender<FrameReport>,
    /// How full the rows of the budget are.
    pub usage: &'run Usage,
    /// Set when the run shall end.
    pub stop: &'run AtomicBool,
}

/// What changes from frame to frame.
struct State {
    given_poses: Option<GivenPoses>,
    slots: SlotsSeen,
    held_out: HeldOutRule,
    n_keyframes: u32,
    /// Frames of the camera process that sends at present.
    n_frames_of_camera: u64,
    last_frame_ns: Option<TimestampNs>,
}

impl TrackingThread<'_> {
    /// Tracks until the stream ends or the run is stopped.
    ///
    /// # Errors
    /// [`RunError::Input`] when the shared memory breaks down.
    pub fn run(mut self, mut input: FrameInput) -> Result<(), RunError> {
        let failed = |e: crate::input::InputError| RunError::Input(e.to_string());
        let given_poses = self.plan.given_poses.as_ref().map(GivenPoses::open).transpose();
        let given_poses = given_poses.map_err(|e| RunError::Input(e.to_string()))?;
        let mut gray = vec![0; self.plan.camera.width as usize * self.plan.camera.height as usize];
        let mut state = State {
            given_poses,
            slots: SlotsSeen::new(self.plan.budget.capacity(Row::IpcFrameSlots)),
            held_out: HeldOutRule::default(),
            n_keyframes: 0,
            n_frames_of_camera: 0,
            last_frame_ns: None,
        };
        let mut sealed = None;
        let mut waiting_since = Instant::now();
        while !self.stop.load(Ordering::Relaxed) {
            if sealed.is_none() && state.n_frames_of_camera >= WARM_UP_FRAMES {
                sealed = Some(seal::enter());
            }
            match input.wait(LOOK_INTERVAL).map_err(failed)? {
                InputEvent::Frame(frame) => {
                    self.frame(&frame, &mut gray, &mut state, waiting_since.elapsed());
                    drop(frame);
                    waiting_since = Instant::now();
                }
                InputEvent::Refused(verdict) => self.tell(Record::Refused(verdict)),
                InputEvent::CameraCame { is_first } => self.tell(Record::CameraCame { is_first }),
                InputEvent::CameraGone { silent_for } => {
                    // Meeting the next process takes memory, as meeting the first did.
                    (sealed, state.n_frames_of_camera) = (None, 0);
                    state.slots.forget();
                    self.tell(Record::CameraGone { silent_for });
                }
                InputEvent::Timeout { camera, silent_for } => self.tell(Record::Waiting { camera, silent_for }),
                InputEvent::End => break,
            }
        }
        drop(sealed);
        let counts = input.counts();
        let n_keyframes_dropped = self.mapper.as_ref().map_or(0, MapperLink::n_dropped);
        let n_frame_indices = input.n_frame_indices();
        // The last record is worth waiting for.
        let end = Record::End { input: counts, camera: input.camera_state(), n_frame_indices, n_keyframes_dropped };
        self.records
            .push(end)
            .map_err(|_| RunError::Run("handing over the last record: the main thread is gone".to_owned()))
    }

    /// One frame; the slot of shared memory is borrowed until this returns.
    fn frame(&mut self, frame: &BorrowedFrame<'_>, gray: &mut [u8], state: &mut State, waited: Duration) {
        let mut times = StageTimes::default();
        times.add(Stage::Input, milliseconds(waited));
        let frame_index = frame.frame_index();
        state.n_frames_of_camera += 1;
        let started = Instant::now();
        let image = CameraImage::of_frame(frame);
        let Some(gray) = image.gray(gray) else {
            let (claimed_bytes, sent_bytes) = (frame.header().payload_bytes, image.pixels.len() as u64);
            let needed_bytes = (image.stride_bytes * image.size.1) as u64;
            return self.tell(Record::Refused(HeaderVerdict::DoesNotFit { needed_bytes, claimed_bytes, sent_bytes }));
        };
        let before_ns = state.last_frame_ns.replace(frame.timestamp_ns());
        let travelled = before_ns.and_then(|before_ns| frame.speeds().between(before_ns, frame.timestamp_ns()));
        let travelled = travelled.map(|way| Travelled { metres: way.metres, sigma_m: way.sigma_m });
        let mut aids = self.matchers.aids(travelled);
        let mut report = self.tracker.step_aided(gray, frame_index, frame.timestamp_ns(), &mut aids);
        if let Some(given_poses) = &mut state.given_poses {
            given_poses.replace(&mut report);
        }
        times.add(Stage::Tracking, milliseconds(started.elapsed()));
        self.observe(&image, &mut state.slots);
        self.usage.observe(Row::TrackingSpeedReadings, frame.speeds().len());
        state.n_keyframes += u32::from(report.is_tracked_keyframe());
        // A full queue means that the publisher is late: its readers want the next one.
        let _ = self.odometry.try_push(report);
        let is_place = LoopLink::wants(&report);
        self.loops.iter_mut().filter(|_| is_place).for_each(LoopLink::settle);
        self.hand_to_mapper(&image, &gray, &report, state, &mut times);
        if let Some(loops) = self.loops.as_mut().filter(|_| is_place) {
            loops.keyframe(&gray, &report, self.tracker.keyframe_points());
        }
        self.tell(Record::Frame { report, times });
    }

    /// Notes how full the tracker's containers are, and which slots of shared memory the camera has used.
    fn observe(&self, image: &CameraImage<'_>, slots: &mut SlotsSeen) {
        let fill = self.tracker.fill();
        for (row, n) in [
            (Row::IpcFrameSlots, slots.see(image.pixels)),
            (Row::TrackingGrayImages, usize::from(!image.has_gray_plane())),
            (Row::TrackingPyramids, fill.pyramids),
            (Row::TrackingLandmarks, fill.landmarks),
            (Row::TrackingKeyframes, fill.keyframes),
        ] {
            self.usage.observe(row, n);
        }
        self.matchers.observe(self.usage);
    }

    fn hand_to_mapper(
        &mut self,
        image: &CameraImage<'_>,
        gray: &ImageView<'_>,
        report: &FrameReport,
        state: &mut State,
        times: &mut StageTimes,
    ) {
        let Some(link) = &mut self.mapper else { return };
        let is_lost_in_the_map = self.loops.as_ref().is_some_and(|loops| !loops.is_located());
        if report.status != FrameStatus::Tracked || is_lost_in_the_map {
            return;
        }
        let is_held_out = state.held_out.admits(report.frame_index, state.n_keyframes);
        if is_held_out {
            link.held_out((image, gray), report, times);
        } else if report.is_keyframe && !crate::map_store::is_held_out_frame(report.frame_index) {
            let points_scale = state.given_poses.as_ref().map_or(Some(1.0), GivenPoses::points_scale);
            link.keyframe((image, gray), report, (&self.tracker, points_scale), times);
        }
    }

    /// Live, a record that finds no room is lost and shows as a dropped frame; in lock-step it waits.
    fn tell(&self, record: Record) {
        let told = if self.plan.is_live() { self.records.try_push(record) } else { self.records.push(record) };
        if told.is_err() {
            log::debug!("a record found no room");
        }
    }
}

/// The places in shared memory where frames have been met; a camera process goes round in them.
struct SlotsSeen {
    addresses: Vec<usize>,
}

impl SlotsSeen {
    /// Remembers at most `n_slots` places, without taking memory later.
    fn new(n_slots: usize) -> Self {
        Self { addresses: Vec::with_capacity(n_slots) }
    }

    /// Notes where a frame lies; returns how many different places there were.
    fn see(&mut self, pixels: &[u8]) -> usize {
        let address = pixels.as_ptr().addr();
        if !self.addresses.contains(&address) && self.addresses.len() < self.addresses.capacity() {
            self.addresses.push(address);
        }
        self.addresses.len()
    }

    /// Another camera process has memory of its own.
    fn forget(&mut self) {
        self.addresses.clear();
    }
}

/// A duration as it is reported.
pub fn milliseconds(duration: Duration) -> f32 {
    duration.as_secs_f32() * 1e3
}
