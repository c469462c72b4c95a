//! The way from the tracking thread to the mapping thread: a few jobs that travel to and fro.

use super::camera_image::CameraImage;
use super::plan::RunPlan;
use super::queue::{Received, Receiver, Sender, queue};
use crate::budget::{Row, Usage};
use crate::output::{STAGES, StageTimes};
use kilogs_core::frame::{ImageView, PixelFormat};
use kilogs_core::tracking::{FrameReport, KeyframePoint, RoadPlane, Tracker};
use std::sync::Arc;
use std::time::Duration;

/// A keyframe or held-out view on its way; the same few travel to and fro for the whole run.
pub(super) struct Job {
    pub(super) report: Option<FrameReport>,
    pub(super) is_held_out: bool,
    /// Packed, in the map's format.
    pub(super) pixels: Box<[u8]>,
    pub(super) points: Vec<KeyframePoint>,
    pub(super) road: Option<RoadPlane>,
    pub(super) times: StageTimes,
}

/// The mapping thread's end: jobs come in, and go back when they are done.
pub(super) type MapperEnd = (Receiver<Box<Job>>, Sender<Box<Job>>);

/// The tracking thread's end.
pub struct MapperLink {
    jobs: Sender<Box<Job>>,
    free: Receiver<Box<Job>>,
    waits: bool,
    /// In lock-step the job that came home.
    at_home: Option<Box<Job>>,
    n_dropped: u64,
    n_jobs: usize,
    map_format: PixelFormat,
    /// The tracker's road lies as far below the camera as it does, whatever the scale of the odometry.
    knows_height: bool,
    usage: Arc<Usage>,
}

impl MapperLink {
    /// Takes the memory of the jobs.
    pub(super) fn new(plan: &RunPlan, usage: &Arc<Usage>) -> (Self, MapperEnd) {
        let n_jobs = if plan.is_live() { plan.budget.capacity(Row::PipelineKeyframeQueue) } else { 1 };
        let (jobs, incoming) = queue(n_jobs);
        let (back, free) = queue(n_jobs);
        for _ in 0..n_jobs {
            let job = Job {
                report: None,
                is_held_out: false,
                pixels: vec![0; plan.frame_bytes()].into(),
                points: Vec::with_capacity(plan.budget.capacity(Row::TrackingTracks)),
                road: None,
                times: StageTimes::default(),
            };
            let pushed = back.push(Box::new(job));
            debug_assert!(pushed.is_ok(), "the queue has room for every job");
        }
        let link = Self {
            jobs,
            free,
            waits: !plan.is_live(),
            at_home: None,
            n_dropped: 0,
            n_jobs,
            map_format: plan.pixel_format,
            knows_height: plan.mounting.is_some(),
            usage: Arc::clone(usage),
        };
        (link, (incoming, back))
    }

    /// Hands a keyframe over; live it is dropped, and counted, when the mapper is busy with two others. The tracker's
    /// depths are multiplied by `points_scale` and left out without one; its road too, where it has no known height.
    pub fn keyframe(
        &mut self,
        image: (&CameraImage<'_>, &ImageView<'_>),
        report: &FrameReport,
        (tracker, points_scale): (&Tracker<'_>, Option<f32>),
        times: &mut StageTimes,
    ) {
        let Some(mut job) = self.take() else { return };
        job.is_held_out = false;
        job.points.clear();
        if let Some(scale) = points_scale {
            let n_points = tracker.keyframe_points().len().min(job.points.capacity());
            let points = tracker.keyframe_points().iter().take(n_points);
            job.points.extend(points.map(|point| KeyframePoint { depth_m: scale * point.depth_m, ..*point }));
        }
        let road_scale = if self.knows_height { Some(1.0) } else { points_scale.map(f64::from) };
        let scaled = |road: RoadPlane, scale: f64| RoadPlane { height_m: scale * road.height_m, ..road };
        job.road = tracker.road_plane().zip(road_scale).map(|(road, scale)| scaled(road, scale));
        self.send(job, image, report, times);
    }

    /// Hands over a view that is only stored, to judge the map by.
    pub fn held_out(
        &mut self,
        image: (&CameraImage<'_>, &ImageView<'_>),
        report: &FrameReport,
        times: &mut StageTimes,
    ) {
        let Some(mut job) = self.take() else { return };
        job.is_held_out = true;
        self.send(job, image, report, times);
    }

    /// Keyframes that found no room.
    pub fn n_dropped(&self) -> u64 {
        self.n_dropped
    }

    fn take(&mut self) -> Option<Box<Job>> {
        if self.waits {
            return self.at_home.take().or_else(|| self.free.pop());
        }
        match self.free.pop_within(Duration::ZERO) {
            Received::Element(job) => Some(job),
            Received::Empty | Received::Closed => {
                self.n_dropped += 1;
                self.usage.refuse(Row::PipelineKeyframeQueue, 1);
                None
            }
        }
    }

    fn send(
        &mut self,
        mut job: Box<Job>,
        (image, gray): (&CameraImage<'_>, &ImageView<'_>),
        report: &FrameReport,
        times: &mut StageTimes,
    ) {
        image.pack(gray, self.map_format, &mut job.pixels);
        job.report = Some(*report);
        job.times = StageTimes::default();
        self.usage.observe(Row::PipelineKeyframeQueue, self.n_jobs.saturating_sub(self.free.n_waiting()));
        if self.jobs.push(job).is_err() {
            self.n_dropped += 1;
            return;
        }
        if !self.waits {
            return;
        }
        // In lock-step the frame is done when its mapping is.
        self.at_home = self.free.pop();
        if let Some(done) = &self.at_home {
            for (stage, _) in STAGES {
                times.add(stage, done.times.ms(stage));
            }
        }
    }
}
