//! The way from the tracking thread to the loop closer: a few jobs that travel to and fro.

use super::SharedAlignment;
use crate::budget::{Row, Usage};
use crate::pipeline::plan::RunPlan;
use crate::pipeline::queue::{Received, Receiver, Sender, queue};
use kilogs_core::frame::ImageView;
use kilogs_core::tracking::{FrameReport, KeyframePoint, StatusReason};
use nalgebra::Matrix6;
use std::sync::Arc;
use std::time::Duration;

/// A keyframe on its way; the same few travel to and fro for the whole run.
pub(super) struct Job {
    pub(super) report: Option<FrameReport>,
    /// By how much the odometry's covariance grew since the keyframe before, where tracking was lost on the way.
    pub(super) blind: Option<Matrix6<f64>>,
    /// Packed.
    pub(super) gray: Box<[u8]>,
    pub(super) points: Vec<KeyframePoint>,
}

/// The loop closer's end: jobs come in, and go back when they are done.
pub(super) type LoopEnd = (Receiver<Box<Job>>, Sender<Box<Job>>);

/// The tracking thread's end.
pub struct LoopLink {
    jobs: Sender<Box<Job>>,
    free: Receiver<Box<Job>>,
    waits: bool,
    /// In lock-step the job that came home.
    at_home: Option<Box<Job>>,
    n_jobs: usize,
    usage: Arc<Usage>,
    alignment: SharedAlignment,
    is_located: bool,
    /// Covariance of the keyframe before.
    covariance: Matrix6<f64>,
    /// Tracking began anew since then.
    was_lost: bool,
}

impl LoopLink {
    /// Takes the memory of the jobs.
    pub(super) fn new(plan: &RunPlan, usage: &Arc<Usage>, alignment: &SharedAlignment) -> (Self, LoopEnd) {
        let n_jobs = if plan.is_live() { plan.budget.capacity(Row::PipelineLoopQueue) } else { 1 };
        let (jobs, incoming) = queue(n_jobs);
        let (back, free) = queue(n_jobs);
        for _ in 0..n_jobs {
            let job = Job {
                report: None,
                blind: None,
                gray: vec![0; plan.camera.width as usize * plan.camera.height as usize].into(),
                points: Vec::with_capacity(plan.budget.capacity(Row::TrackingTracks)),
            };
            let pushed = back.push(Box::new(job));
            debug_assert!(pushed.is_ok(), "the queue has room for every job");
        }
        let link = Self {
            jobs,
            free,
            waits: !plan.is_live(),
            at_home: None,
            n_jobs,
            usage: Arc::clone(usage),
            alignment: alignment.clone(),
            is_located: alignment.is_located(),
            covariance: Matrix6::zeros(),
            was_lost: false,
        };
        (link, (incoming, back))
    }

    /// In lock-step waits until the keyframe before is through: what it changed holds from here on.
    pub fn settle(&mut self) {
        if self.waits && self.at_home.is_none() {
            self.at_home = self.free.pop();
        }
        self.is_located = self.alignment.is_located();
    }

    /// Whether it is known where in the map the drive is; changes only when a keyframe is settled.
    pub fn is_located(&self) -> bool {
        self.is_located
    }

    /// Whether a frame is a keyframe for the closer: a tracked one, or one at which tracking begins anew, wherever that is.
    pub fn wants(report: &FrameReport) -> bool {
        report.is_tracked_keyframe() || (report.is_keyframe && report.reason == StatusReason::Restarted)
    }

    /// Hands a keyframe over; live it is left out, and counted, when the closer is busy with others.
    pub fn keyframe(&mut self, gray: &ImageView<'_>, report: &FrameReport, points: &[KeyframePoint]) {
        self.settle();
        self.was_lost |= report.reason == StatusReason::Restarted;
        let Some(mut job) = self.at_home.take().or_else(|| self.take()) else {
            self.usage.refuse(Row::PipelineLoopQueue, 1);
            return;
        };
        for (y, row) in job.gray.chunks_exact_mut(gray.width()).take(gray.height()).enumerate() {
            row.copy_from_slice(gray.row(y));
        }
        let n_points = points.len().min(job.points.capacity());
        job.points.clear();
        job.points.extend_from_slice(&points[..n_points]);
        job.report = Some(*report);
        job.blind = self.was_lost.then(|| report.covariance - self.covariance);
        (self.covariance, self.was_lost) = (report.covariance, false);
        self.usage.observe(Row::PipelineLoopQueue, self.n_jobs.saturating_sub(self.free.n_waiting()));
        // A closer that is gone has told why.
        let _ = self.jobs.push(job);
    }

    fn take(&self) -> Option<Box<Job>> {
        match self.free.pop_within(Duration::ZERO) {
            Received::Element(job) => Some(job),
            Received::Empty | Received::Closed => None,
        }
    }
}
