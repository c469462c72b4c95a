//! The whole command: memory, training, store, judgement, reports.

use super::effort::{Clock, Effort};
use super::images::TrainingImages;
use super::scene::Scene;
use super::trainer::Trainer;
use crate::budget::{Row, Usage};
use crate::map_store::{MapStoreWriter, is_held_out_frame};
use crate::mapping::{CHUNK_KEYFRAMES, PAGE_KEYFRAMES, capacity, mapping_camera};
use crate::output::{OutputFolder, StageTimes};
use crate::pipeline::{self, Concluded, MappingSummary, RunPlan, ScaleSource, Tally, Told};
use crate::run_error::RunError;
use crate::telemetry::MemoryWatch;
use indicatif::{ProgressBar, ProgressStyle};
use kilogs_core::conventions::Rigid;
use kilogs_core::scale::ScaleSources;
use kilogs_core::tracking::{FrameReport, FrameStatus, MatchSource, PoseModel, StatusReason};
use nalgebra::Matrix6;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// What to do.
pub struct FitRequest {
    /// The posed images.
    pub scene: Scene,
    /// Settings, budget, outputs.
    pub plan: RunPlan,
    /// How long to train.
    pub effort: Effort,
}

/// Ticks of the progress bar.
const BAR_TICKS: u64 = 1000;

/// Fits a map and writes everything that a run leaves behind.
///
/// # Errors
/// [`RunError`]; after Ctrl-C the outputs are complete with what was trained until then.
pub fn run(request: FitRequest) -> Result<(), RunError> {
    let FitRequest { scene, plan, effort } = request;
    let started = Instant::now();
    let is_interrupted = Arc::new(AtomicBool::new(false));
    let on_signal = Arc::clone(&is_interrupted);
    ctrlc::set_handler(move || on_signal.store(true, Ordering::Relaxed))
        .map_err(|e| RunError::Run(format!("taking over Ctrl-C: {e}")))?;
    let mut folder = OutputFolder::create(&plan.out, &Rigid::identity())?;
    let mut tally = Tally::with_scale_source(ScaleSource::GivenPoses);
    let mut watch = MemoryWatch::new(None);
    watch.read();
    let mut reports = FrameReports::default();
    for (view, nth) in scene.views.iter().zip(0..) {
        let report = reports.next(nth, view.timestamp_ns, &view.world_from_camera);
        folder.frame(&report, &StageTimes::default())?;
        tally.pose(&report);
    }
    let usage = Usage::default();
    let mapping = train(scene, &plan, effort, &usage, &mut |progress, bar| {
        watch.sample(Instant::now(), 0.0);
        bar.set_position((progress.clamp(0.0, 1.0) * BAR_TICKS as f64) as u64);
        !is_interrupted.load(Ordering::Relaxed)
    })?;
    let told = Told { folder, tally, watch, failure: None, camera_failure: None };
    pipeline::conclude(&plan, &usage, Concluded { told, mapping: Some(mapping), loops: Default::default(), started })
}

fn train(
    scene: Scene,
    plan: &RunPlan,
    effort: Effort,
    usage: &Usage,
    on_progress: &mut dyn FnMut(f64, &ProgressBar) -> bool,
) -> Result<MappingSummary, RunError> {
    let mut mapper = pipeline::mapper(plan)?;
    mapper.lift_quota();
    let store =
        MapStoreWriter::create(&plan.out.join("map"), &pipeline::manifest(plan), &pipeline::store_settings(plan))?;
    let bar = ProgressBar::new(BAR_TICKS).with_style(progress_style());
    // The anchors of views that are trained together keep their rows.
    let capacity = mapper.capacity();
    let rows = capacity.keyframe_rows.min((capacity.chunk_rows - 1) * CHUNK_KEYFRAMES as usize);
    let mut trainer = Trainer {
        step: plan.settings.mapping.mapper.step,
        coarse_resolution: plan.settings.mapping.mapper.resolution,
        store: &store,
        images: TrainingImages::new(scene.images, scene.camera, kept_bytes(plan)),
        views: &scene.views,
        points: &scene.points,
        native: scene.camera,
        mounting: scene.mounting,
        clock: Clock::start(effort),
        usage,
        max_active: rows.saturating_sub(PAGE_KEYFRAMES as usize).max(2),
        max_points: plan.budget.capacity(Row::TrackingTracks),
        seed: plan.seed,
        training: Duration::ZERO,
        n_steps: 0,
        on_progress: &mut |progress| on_progress(progress, &bar),
        mapper,
    };
    trainer.run()?;
    let anchors_resident = u64::from(trainer.mapper.n_resident_anchors());
    trainer.mapper.finish_into(&store)?;
    let (counters, training) = (trainer.mapper.counters(), trainer.training);
    usage.note_map_refusals(&counters.refused);
    if trainer.n_steps > 0 && counters.iterations == 0 {
        return Err(RunError::Run(
            "training the map: the compute device refuses every step; look for poses and intrinsics that are no sane \
             numbers, or try --backend cpu"
                .to_owned(),
        ));
    }
    // The mapper's memory is needed for judging the map.
    drop(trainer);
    bar.finish_and_clear();
    let store = store.finish()?;
    Ok(MappingSummary { counters, anchors_resident, store, training, n_images_left_out: 0, n_views_refused: 0 })
}

/// What the budget grants keyframe images, less what the mapper keeps at its own resolution.
fn kept_bytes(plan: &RunPlan) -> usize {
    let channels = plan.memory_input.color_channels as usize;
    let each = |resolution: f64| capacity::bytes_per_image(&mapping_camera(&plan.camera, resolution), channels);
    let n = plan.budget.capacity(Row::MapKeyframeImages);
    n * each(1.0).saturating_sub(each(plan.settings.mapping.mapper.resolution))
}

fn progress_style() -> ProgressStyle {
    ProgressStyle::with_template("fitting {bar:40} {percent} %, {elapsed}, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Given poses in the words of a tracker: every view that is not held out is a keyframe.
#[derive(Default)]
struct FrameReports {
    keyframe: Option<(u32, Rigid)>,
}

impl FrameReports {
    fn next(&mut self, frame_index: u64, timestamp_ns: u64, world_from_camera: &Rigid) -> FrameReport {
        let is_keyframe = !is_held_out_frame(frame_index);
        let next_ordinal = self.keyframe.map_or(0, |(ordinal, _)| ordinal + 1);
        let (keyframe_ordinal, world_from_keyframe) = match self.keyframe {
            Some(keyframe) if !is_keyframe => keyframe,
            _ => (next_ordinal, *world_from_camera),
        };
        self.keyframe = Some((keyframe_ordinal, world_from_keyframe));
        FrameReport {
            frame_index,
            timestamp_ns,
            status: FrameStatus::Tracked,
            reason: StatusReason::Verified,
            model: PoseModel::Origin,
            source: MatchSource::Tracks,
            is_keyframe,
            keyframe_ordinal,
            keyframe_from_camera: world_from_keyframe.inverse() * world_from_camera,
            world_from_camera: *world_from_camera,
            // What is given is taken as exact.
            covariance: Matrix6::zeros(),
            n_tracks: 0,
            n_matches: 0,
            n_inliers: 0,
            n_dynamic: 0,
            median_flow_px: f32::NAN,
            gric: [f32::NAN; 2],
            rotation_anomaly_rad: f32::NAN,
            direction_anomaly_rad: f32::NAN,
            step_m: f32::NAN,
            scale_ratio: f32::NAN,
            scale_sigma: f32::NAN,
            scale_sources: ScaleSources::NONE,
            n_road: 0,
        }
    }
}
