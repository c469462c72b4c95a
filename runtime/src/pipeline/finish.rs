//! After the drive: trajectories, the final map judged, the reports.

use super::loops::LoopSummary;
use super::mapping_thread::MappingSummary;
use super::memory;
use super::nothing_tracked::nothing_tracked;
use super::plan::RunPlan;
use super::supervisor::Told;
use super::tally::Tally;
use crate::budget::{Row, Usage};
use crate::map_store::{MapStoreEditor, MapStoreReader};
use crate::output::report::{Backend, Mapping, Memory, Report, Time, Tracking};
use crate::output::{RenderedKeyframe, Renders, VIEWS_CSV, ViewTable, write_html};
use crate::render_views::{MapQuality, judge_map};
use crate::run_error::RunError;
use crate::seal;
use crate::splat::Overflow;
use crate::telemetry::MemoryWatch;
use std::time::Instant;

/// Everything that a drive leaves behind.
pub struct Concluded {
    /// What the main thread knows.
    pub told: Told,
    /// What mapping did, when it was on.
    pub mapping: Option<MappingSummary>,
    /// What closing loops did.
    pub loops: LoopSummary,
    /// Start of the run.
    pub started: Instant,
}

/// Writes what is written once, all of it that can be: what is not known for a failure is null in the report.
///
/// # Errors
/// [`RunError`] of what ended the drive, else of what could not be written or judged, else of the camera process, else of a
/// drive without one tracked frame.
pub fn conclude(plan: &RunPlan, usage: &Usage, drive: Concluded) -> Result<(), RunError> {
    let Concluded { told, mapping, loops, started } = drive;
    let mut failures: Vec<RunError> = told.failure.into_iter().collect();
    let sealed = seal::report();
    let counts = told.folder.counts();
    let path_length_m = kept(told.folder.finish().map(|trajectory| trajectory.path_length_m), &mut failures);
    let (quality, pictures) = match &mapping {
        Some(_) => kept(judge(plan), &mut failures),
        None => Default::default(),
    };
    let mut watch = told.watch;
    watch.read();
    observe_at_the_end(usage, mapping.as_ref(), &watch);
    let (per_frame_ms, tracking_ms) = told.tally.percentiles();
    let iterations = mapping.map_or(0, |m| m.counters.iterations);
    let training_s = mapping.map_or(0.0, |m| m.training.as_secs_f64());
    let report = Report {
        command: plan.command.clone(),
        frames: crate::output::report::Frames { refused: told.tally.n_refused(), ..counts.into() },
        time: Time {
            wall_s: Some(started.elapsed().as_secs_f64()),
            per_frame_ms,
            tracking_ms,
            mapping_iterations: iterations,
            mapping_it_per_s: (training_s > 0.0).then(|| iterations as f64 / training_s),
        },
        memory: Memory {
            rss_peak_bytes: Some(watch.own().peak_bytes),
            camera_rss_peak_bytes: watch.camera().map(|camera| camera.peak_bytes),
            device_peak_bytes: plan.compute.device_peak_bytes(),
            sealed_allocations: sealed.sealed_allocations,
            rss_slope_bytes_per_km: watch.growth().map(|growth| growth.bytes_per_km),
            ..Memory::planned(&plan.memory, usage, plan.budget.host_bytes(), plan.budget.device_bytes())
        },
        tracking: Tracking { loops: loops.n_loops, ..told.tally.tracking(path_length_m) },
        mapping: mapping.map_or_else(Mapping::default, |m| mapping_report(&m, &quality)),
        backend: Backend {
            kind: mapping.map(|_| plan.compute.kind().to_owned()),
            device: plan.compute.name(),
            simd: Some(plan.simd.name().to_owned()),
            threads: plan.n_threads as u64,
        },
        ..Report::default()
    };
    kept(report.write(&plan.out), &mut failures);
    kept(write_html(&plan.out, &report, told.tally.chart(), &pictures), &mut failures);
    summarize(plan, &report);
    if let Some(growth) = watch.growth() {
        log::info!("memory after the first 300 m: {growth}");
    }
    warn_of_losses(mapping.as_ref(), &told.tally, &quality);
    failures.extend(told.camera_failure);
    if failures.is_empty() {
        failures.extend(nothing_tracked(&counts, told.tally.n_refused(), told.tally.last_refusal()));
    }
    let mut failures = failures.into_iter();
    let first = failures.next();
    // What ends the run is printed by main.
    failures.for_each(|later| log::error!("{later}"));
    first.map_or(Ok(()), Err)
}

/// What came of a step, or nothing and one failure more.
fn kept<T: Default, E: Into<RunError>>(result: Result<T, E>, failures: &mut Vec<RunError>) -> T {
    result.unwrap_or_else(|failure| {
        failures.push(failure.into());
        T::default()
    })
}

/// What is missing in the outputs, where anything is.
fn warn_of_losses(mapping: Option<&MappingSummary>, tally: &Tally, quality: &MapQuality) {
    let n_left_out = mapping.map_or(0, |m| m.n_images_left_out);
    let n_keyframes_dropped = tally.n_keyframes_dropped();
    if n_left_out + n_keyframes_dropped > 0 {
        log::warn!(
            "late: {n_keyframes_dropped} keyframes came while the mapper was busy, {n_left_out} images while the disk was"
        );
    }
    for source in tally.silent_sources() {
        log::warn!(
            "tracking.scale_source: {source} never told a scale that could be taken over; metres come from the others"
        );
    }
    let (input, viewer) = (tally.input(), &quality.viewer);
    let Overflow { visible_gaussians, row_entries, pairs } = viewer.overflow;
    let n_overflowed = [visible_gaussians, row_entries, pairs].map(u64::from).iter().sum::<u64>();
    for (n, what) in [
        (mapping.map_or(0, |m| m.counters.pages_lost), "pages could not come back to where the vehicle was; see above"),
        (mapping.map_or(0, |m| m.n_views_refused), "views could not be used by the map, see above; it is without them"),
        (input.n_connection_failures, "times the memory of a camera process could not be mapped"),
        (input.n_ack_failures, "frames could not be acknowledged to the camera"),
        (quality.views_skipped, "pictures of stored views cannot be read and are not in the figures"),
        (viewer.pages_damaged, "pages of the map could not be read; what they held is missing in the figures"),
        (viewer.anchors_left_out, "anchors of the map could not be shown and are missing in the figures"),
        (n_overflowed, "elements of [splat] found no room while the map was judged; their renders are incomplete"),
        (viewer.backgrounds_missing, "backgrounds of the map could not be read and were judged as grey"),
    ] {
        if n > 0 {
            log::warn!("{n} {what}");
        }
    }
}

/// Notes what is known only now.
fn observe_at_the_end(usage: &Usage, mapping: Option<&MappingSummary>, watch: &MemoryWatch) {
    if let Some(mapping) = mapping {
        let counts = &mapping.store.counts;
        usage.observe(Row::StoreKeyframeTable, (counts.keyframes + counts.held_out) as usize);
    }
    if let Some(camera) = watch.camera() {
        // The shared frames have a row of their own.
        usage.observe(Row::ProcessCameraChild, camera.peak_bytes.saturating_sub(camera.shared_bytes) as usize);
    }
}

fn judge(plan: &RunPlan) -> Result<(MapQuality, Vec<RenderedKeyframe>), RunError> {
    let map = MapStoreReader::open(&plan.map_folder(), plan.budget.capacity(Row::StoreKeyframeTable))?;
    if plan.settings.mapping.mapper.shared_decoder {
        // Chunks that left in the drive have it as it was then.
        let mut editor = MapStoreEditor::open(&map, plan.budget.store_capacity().page_bytes)?;
        editor.share_newest_decoder(&map)?;
        editor.finish()?;
    }
    let mut backend = memory::backend(plan)?;
    let mut renders = Renders::new(&plan.out, map.keyframes().len());
    let mut table = ViewTable::create(&plan.out.join(VIEWS_CSV))?;
    let quality = judge_map(&map, backend.as_mut(), &mut |view| {
        table.push(view)?;
        Ok(renders.push(view)?)
    })?;
    table.finish()?;
    if quality.views_without_picture > 0 {
        log::info!(
            "{} keyframes have no picture of their own, because their street had been driven before or the disk was late",
            quality.views_without_picture
        );
    }
    Ok((quality, renders.written()))
}

fn mapping_report(mapping: &MappingSummary, quality: &MapQuality) -> Mapping {
    let counters = &mapping.counters;
    Mapping {
        anchors_resident: mapping.anchors_resident,
        anchors_total: mapping.store.counts.anchors,
        anchors_refused: counters.refused.total(),
        gaussians: mapping.store.counts.gaussians,
        chunks: mapping.store.counts.chunks,
        pages_written: counters.pages_written,
        pages_returned: counters.pages_returned,
        map_bytes: mapping.store.bytes.map_bytes,
        store_bytes: mapping.store.bytes.store_bytes,
        psnr_train_db: quality.train.psnr_db(),
        ssim_train: quality.train.ssim(),
        psnr_heldout_db: quality.held_out.psnr_db(),
        ssim_heldout: quality.held_out.ssim(),
        psnr_worst_100m_db: quality.train.worst_stretch_db(),
    }
}

/// The figures that people look for first, on stderr where the log goes.
fn summarize(plan: &RunPlan, report: &Report) {
    let frames = &report.frames;
    log::info!(
        "{} frames: {} tracked ({} keyframes), {} doubtful, {} lost, {} dropped, {} refused; {:.1} m",
        frames.received,
        frames.tracked,
        frames.keyframes,
        frames.doubtful,
        frames.lost,
        frames.dropped,
        frames.refused,
        report.tracking.path_length_m
    );
    if let (Some(train), held_out) = (report.mapping.psnr_train_db, report.mapping.psnr_heldout_db) {
        let held_out = held_out.map_or_else(|| "unknown".to_owned(), |db| format!("{db:.2} dB"));
        log::info!("map: {} Gaussians, PSNR {train:.2} dB on keyframes, {held_out} held out", report.mapping.gaussians);
    }
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    let rss = report.memory.rss_peak_bytes.unwrap_or(0) + report.memory.camera_rss_peak_bytes.unwrap_or(0);
    log::info!(
        "memory: {:.0} of {:.0} MiB, {} sealed allocations; outputs in {}",
        mib(rss),
        mib(report.memory.budget_host_bytes),
        report.memory.sealed_allocations,
        plan.out.display()
    );
}
