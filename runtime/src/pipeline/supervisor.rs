//! The main thread during a run: starts the others, writes what they tell, watches memory and camera.

use super::child_watch::{camera_failure, progress_bar};
use super::finish::{self, Concluded};
use super::loops::{self, LoopSummary, SharedAlignment};
use super::mapping_thread::{self, MappingProgress};
use super::matchers::Matchers;
use super::plan::RunPlan;
use super::priority::{behind, step_behind};
use super::queue::{self, Received, Receiver};
use super::record::Record;
use super::tally::{ScaleSource, Tally};
use super::tracking_thread::TrackingThread;
use super::{memory, odometry};
use crate::budget::{Row, Usage};
use crate::input::{CameraChild, CameraState, FrameInput, FrameSlots, InputError, InputSettings};
use crate::output::{HealthPublisher, OutputFolder};
use crate::run_error::RunError;
use crate::seal;
use crate::telemetry::MemoryWatch;
use indicatif::ProgressBar;
use kilogs_camera::ipc::HealthMessage;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::ScopedJoinHandle;
use std::time::{Duration, Instant};

/// When this is set, the first allocation on a sealed thread prints where it happened.
const TRACE_VARIABLE: &str = "KILOGS_SEAL_TRACE";

/// How long the thread waits for records before it looks after everything else.
const LOOK_INTERVAL: Duration = Duration::from_millis(100);

/// A camera that sends nothing for so long is told.
const LONG_SILENCE: Duration = Duration::from_secs(1);

/// Runs everything and writes everything.
///
/// # Errors
/// [`RunError`]; the outputs of what was done until then are complete.
pub fn supervise(
    plan: &RunPlan,
    service: &str,
    start_camera: impl FnOnce() -> Result<Option<CameraChild>, InputError>,
) -> Result<(), RunError> {
    let started = Instant::now();
    plan.tracker_mounting()?;
    seal::prefault_pools();
    if std::env::var_os(TRACE_VARIABLE).is_some() {
        seal::trace_next_violation();
    }
    let folder = OutputFolder::create(&plan.out, &plan.map_from_odometry())?;
    let usage = Arc::new(Usage::default());
    let (stop, is_interrupted) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicBool::new(false)));
    let on_signal = [Arc::clone(&is_interrupted), Arc::clone(&stop)];
    ctrlc::set_handler(move || on_signal.iter().for_each(|flag| flag.store(true, Ordering::Relaxed)))
        .map_err(|e| RunError::Run(format!("taking over Ctrl-C: {e}")))?;

    let (records, incoming) = queue::queue(plan.budget.capacity(Row::TelemetryFrameRecords));
    let tracker = memory::tracker(plan)?;
    let matchers = Matchers::open(plan)?;
    let progress = Arc::new(MappingProgress::default());
    let alignment = SharedAlignment::new(loops::alignment_before(plan)?);
    let spawn_failed = |e: std::io::Error| RunError::Run(format!("starting a thread: {e}"));
    let prepare = || mapping_thread::prepare(plan, &usage, &progress, &alignment);
    // In lock-step tracking waits for mapping anyway.
    let mapping = if plan.is_live() { behind(prepare).map_err(spawn_failed)?? } else { prepare()? };
    let (mapper_link, mapping_work) = mapping.map_or((None, None), |(link, work)| (Some(link), Some(work)));
    let closing = loops::prepare(plan, &usage, &alignment)?;
    let (loop_link, loop_work) = closing.map_or((None, None), |(link, work)| (Some(link), Some(work)));
    let settings = InputSettings {
        service: service.to_owned(),
        format: plan.service_format(),
        slots: plan.budget.frame_slots(),
        is_recorded: !plan.is_live(),
        speed_readings: plan.budget.capacity(Row::TrackingSpeedReadings),
    };
    // Before the camera is started: whoever creates the service decides how many slots it has.
    let input = FrameInput::open(&settings).map_err(|e| RunError::Input(e.to_string()))?;
    check_slots(&settings, input.slots())?;
    let (odometry, poses) = queue::queue(odometry::CAPACITY);
    let tracking = TrackingThread {
        plan,
        tracker,
        matchers,
        mapper: mapper_link,
        loops: loop_link,
        records,
        odometry,
        usage: &usage,
        stop: &stop,
    };

    let (mut told, tracked, mapped, closed) = std::thread::scope(|scope| {
        let _ending = StopWhenDropped(&stop);
        let tracking = thread("tracking").spawn_scoped(scope, move || tracking.run(input)).map_err(spawn_failed)?;
        let mapping = mapping_work
            .map(|work| {
                thread("mapping").spawn_scoped(scope, || {
                    if plan.is_live() {
                        step_behind();
                    }
                    work.run()
                })
            })
            .transpose()
            .map_err(spawn_failed)?;
        let closing = loop_work
            .map(|work| {
                thread("loops").spawn_scoped(scope, || {
                    if plan.is_live() {
                        step_behind();
                    }
                    work.run()
                })
            })
            .transpose()
            .map_err(spawn_failed)?;
        let publishing = thread("odometry")
            .spawn_scoped(scope, || odometry::publish(&{ poses }, plan, &alignment))
            .map_err(spawn_failed)?;
        let child = start_camera().map_err(|e| RunError::Input(e.to_string()))?;
        let is_interrupted = is_interrupted.as_ref();
        let shared = Shared { plan, service, stop: &stop, is_interrupted, usage: &usage, progress: &progress, started };
        let told = Supervisor::new(&shared, folder, child)?.run(&incoming);
        if told.failure.is_some() {
            stop.store(true, Ordering::Relaxed);
        }
        drop(incoming);
        let tracked = join(tracking, "tracking").and(join(publishing, "odometry"));
        let closed = closing.map(|thread| join(thread, "loops")).transpose();
        Ok::<_, RunError>((told, tracked, mapping.map(|thread| join(thread, "mapping")), closed))
    })?;
    let (mapping, mapping_failure) = match mapped.transpose() {
        Ok(mapping) => (mapping, None),
        Err(failure) => (None, Some(failure)),
    };
    // What failed first made the others fail.
    let (loops, loops_failure) = match closed {
        Ok(summary) => (summary.unwrap_or_default(), None),
        Err(failure) => (LoopSummary::default(), Some(failure)),
    };
    told.failure = told.failure.take().or(mapping_failure).or(tracked.err()).or(loops_failure);
    let first_keyframe_id = plan.first_keyframe_id();
    {
        let alignment = alignment.lock();
        if !alignment.is_empty() {
            told.folder.align(|ordinal| alignment.at(first_keyframe_id + ordinal))?;
        }
    }
    finish::conclude(plan, &usage, Concluded { told, mapping, loops, started })
}

/// The budget holds what it says: a service that is there already has the slots that its maker gave it.
fn check_slots(settings: &InputSettings, found: FrameSlots) -> Result<(), RunError> {
    let (service, n_found, n_planned) = (&settings.service, found.n_slots(), settings.slots.n_slots());
    if n_found <= n_planned {
        return Ok(());
    }
    Err(RunError::Usage(format!(
        "attaching to \"{service}\": it was made with {n_found} frame slots, and [ipc.frame_slots] plans for {n_planned}; \
         start kilogs before the camera, or set its capacity to {n_found}"
    )))
}

/// The scope waits for its threads whichever way it is left: they have to be told that it is over.
struct StopWhenDropped<'run>(&'run AtomicBool);

impl Drop for StopWhenDropped<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

fn thread(name: &str) -> std::thread::Builder {
    std::thread::Builder::new().name(name.to_owned())
}

fn join<T>(thread: ScopedJoinHandle<'_, Result<T, RunError>>, name: &str) -> Result<T, RunError> {
    thread.join().unwrap_or_else(|_| {
        Err(RunError::Run(format!("the {name} thread ended unexpectedly; please report the message above")))
    })
}

/// What the main thread knows when the drive is over.
pub struct Told {
    /// Files of the run.
    pub folder: OutputFolder,
    /// Figures for the report.
    pub tally: Tally,
    /// Resident sizes.
    pub watch: MemoryWatch,
    /// What ended the drive before its time.
    pub failure: Option<RunError>,
    /// Why the camera process failed, if it did.
    pub camera_failure: Option<RunError>,
}

/// What all threads of a run see.
#[derive(Clone, Copy)]
struct Shared<'run> {
    plan: &'run RunPlan,
    service: &'run str,
    stop: &'run AtomicBool,
    is_interrupted: &'run AtomicBool,
    usage: &'run Usage,
    progress: &'run MappingProgress,
    started: Instant,
}

struct Supervisor<'run> {
    plan: &'run RunPlan,
    service: &'run str,
    folder: OutputFolder,
    child: Option<CameraChild>,
    stop: &'run AtomicBool,
    is_interrupted: &'run AtomicBool,
    tally: Tally,
    watch: MemoryWatch,
    health: HealthPublisher,
    bar: ProgressBar,
    usage: &'run Usage,
    progress: &'run MappingProgress,
    started: Instant,
    next_index: u64,
    camera_state: CameraState,
    n_restarts: u32,
    is_silence_told: bool,
}

impl<'run> Supervisor<'run> {
    fn new(shared: &Shared<'run>, folder: OutputFolder, child: Option<CameraChild>) -> Result<Self, RunError> {
        let Shared { plan, service, stop, is_interrupted, usage, progress, started } = *shared;
        let health = HealthPublisher::open().map_err(|e| RunError::Input(e.to_string()))?;
        let watch = MemoryWatch::new(child.as_ref().map(CameraChild::id));
        let bar = progress_bar(plan.n_frames);
        let measured = ScaleSource::Measured(plan.settings.tracking.tracker.scale_sources);
        let scale_source = if plan.given_poses.is_some() { ScaleSource::GivenPoses } else { measured };
        let tally = Tally::with_scale_source(scale_source);
        Ok(Self {
            plan,
            service,
            folder,
            child,
            stop,
            is_interrupted,
            tally,
            watch,
            health,
            bar,
            usage,
            progress,
            started,
            next_index: 0,
            camera_state: CameraState::NeverCame,
            n_restarts: 0,
            is_silence_told: false,
        })
    }

    /// Until nothing more comes, or something could not be written.
    fn run(mut self, incoming: &Receiver<Record>) -> Told {
        let listened = self.listen(incoming);
        self.watch.read();
        self.publish_health();
        self.usage.observe(Row::TelemetryFrameRecords, incoming.most_waiting());
        self.bar.finish_and_clear();
        // A camera that was left alone by Ctrl-C, or by a run that failed, has done nothing wrong.
        let is_left_alone = self.is_interrupted.load(Ordering::Relaxed) || listened.is_err();
        let child = self.child.as_mut().filter(|_| !is_left_alone);
        let camera_failure = child.and_then(camera_failure);
        Told { folder: self.folder, tally: self.tally, watch: self.watch, failure: listened.err(), camera_failure }
    }

    fn listen(&mut self, incoming: &Receiver<Record>) -> Result<(), RunError> {
        loop {
            match incoming.pop_within(LOOK_INTERVAL) {
                Received::Element(Record::End { input, camera, n_frame_indices, n_keyframes_dropped }) => {
                    self.camera_state = camera;
                    self.missing_until(n_frame_indices)?;
                    self.tally.end(input, n_keyframes_dropped);
                    return Ok(());
                }
                Received::Element(record) => self.record(&record)?,
                Received::Empty => {}
                Received::Closed => return Ok(()),
            }
            if self.watch.sample(Instant::now(), self.tally.odometry_length_m()) {
                self.publish_health();
            }
        }
    }

    fn record(&mut self, record: &Record) -> Result<(), RunError> {
        match record {
            Record::Frame { report, times } => {
                self.missing_until(report.frame_index)?;
                self.next_index = report.frame_index + 1;
                self.usage.observe(Row::TrackingTracks, report.n_tracks as usize);
                self.folder.frame(report, times)?;
                self.tally.frame(report, times, self.watch.own().rss_bytes);
                self.bar.set_position(self.next_index);
                self.is_silence_told = false;
                self.camera_state = CameraState::Sending;
            }
            Record::Refused(verdict) => {
                self.tally.refused(*verdict);
                log::warn!("a camera message was refused: {verdict}");
            }
            Record::CameraCame { is_first } => self.camera_came(*is_first),
            Record::CameraGone { silent_for } => self.camera_gone(*silent_for),
            Record::Waiting { camera, silent_for } => self.waiting(*camera, *silent_for),
            Record::End { .. } => {}
        }
        Ok(())
    }

    /// Frames that never reached the tracker.
    fn missing_until(&mut self, frame_index: u64) -> Result<(), RunError> {
        for missing in self.next_index..frame_index {
            self.folder.dropped(missing, None)?;
        }
        self.next_index = self.next_index.max(frame_index);
        Ok(())
    }

    fn publish_health(&mut self) {
        let counts = self.folder.counts();
        let (_, tracking_ms) = self.tally.percentiles();
        let percentile = |ms: Option<f64>| ms.map_or(f32::NAN, |ms| ms as f32);
        let seconds = self.started.elapsed().as_secs_f64();
        let progress = &self.progress;
        let message = HealthMessage {
            uptime_s: seconds,
            rss_bytes: self.watch.own().rss_bytes,
            rss_peak_bytes: self.watch.own().peak_bytes,
            budget_host_bytes: self.plan.budget.host_bytes(),
            device_bytes: self.plan.compute.arena_bytes(),
            ipc_bytes: self.plan.memory.ipc_bytes(),
            store_bytes: progress.store_bytes.load(Ordering::Relaxed),
            frames_received: counts.received(),
            frames_tracked: counts.tracked,
            frames_doubtful: counts.doubtful,
            frames_lost: counts.lost,
            frames_dropped: counts.dropped,
            frames_refused: self.tally.n_refused(),
            frames_missing: counts.dropped,
            sealed_allocations: seal::report().sealed_allocations,
            refusals: self.usage.refused_in_all(),
            anchors_resident: progress.anchors_resident.load(Ordering::Relaxed),
            tracking_p50_ms: percentile(tracking_ms.p50),
            tracking_p95_ms: percentile(tracking_ms.p95),
            tracking_max_ms: percentile(tracking_ms.max),
            mapping_it_per_s: (progress.iterations.load(Ordering::Relaxed) as f64 / seconds) as f32,
            camera_state: self.camera_state as u32,
            camera_restarts: self.n_restarts,
        };
        // A message that cannot be sent is a loss for the reader, not for the run.
        if let Err(problem) = self.health.publish(&message) {
            log::debug!("{problem}");
        }
    }

    fn camera_came(&mut self, is_first: bool) {
        self.camera_state = CameraState::Silent;
        self.is_silence_told = false;
        if is_first {
            log::info!("the camera is there");
        } else {
            self.n_restarts += 1;
            log::info!("the camera is back; going on");
        }
    }

    fn camera_gone(&mut self, silent_for: Duration) {
        self.camera_state = CameraState::Gone;
        if self.child.is_some() {
            // Our own child does not come back; its message stands above.
            self.stop.store(true, Ordering::Relaxed);
            return;
        }
        log::warn!("{}; Ctrl-C ends the run", CameraState::Gone.describe(self.service, silent_for));
        self.is_silence_told = true;
    }

    fn waiting(&mut self, camera: CameraState, silent_for: Duration) {
        self.camera_state = camera;
        let has_ended = self.child.as_mut().is_some_and(|child| child.exit_status().is_some());
        if has_ended {
            self.stop.store(true, Ordering::Relaxed);
        } else if !self.is_silence_told && silent_for >= LONG_SILENCE {
            log::info!("{}; Ctrl-C ends the run", camera.describe(self.service, silent_for));
            self.is_silence_told = true;
        }
    }
}
