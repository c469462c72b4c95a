//! The whole command: what the map scores, training, what it scores then.

use super::images::StoredImages;
use super::run_folder::RunFolder;
use super::schedule;
use super::stretch::StretchMemory;
use super::summary::{RefineSummary, Scores};
use super::trainer::{Trainer, TrainingCounts};
use crate::budget::Row;
use crate::fit::{Clock, Effort, TrainingImages};
use crate::map_store::{MapStoreEditor, MapStoreReader};
use crate::mapping::{PruneLimits, mapping_camera};
use crate::output::{Renders, ViewTable};
use crate::pipeline::{self, RunPlan};
use crate::render_views::judge_map;
use crate::run_error::RunError;
use indicatif::{ProgressBar, ProgressStyle};
use kilogs_core::map::quota::RouteMeasure;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

/// What to do.
pub struct RefineRequest<'a> {
    /// The map.
    pub map: &'a MapStoreReader,
    /// Settings, budget and device.
    pub plan: &'a RunPlan,
    /// How long to train.
    pub effort: Effort,
    /// Where to write what each view scores afterwards.
    pub views_csv: Option<&'a Path>,
}

/// Ticks of the progress bar.
const BAR_TICKS: u64 = 1000;

/// Improves the map and says by how much.
///
/// # Errors
/// [`RunError`]; what was stored until then stays and is whole. Ctrl-C ends with what was trained until then.
pub fn run(request: &RefineRequest<'_>) -> Result<RefineSummary, RunError> {
    let RefineRequest { map, plan, effort, views_csv } = *request;
    let is_interrupted = Arc::new(AtomicBool::new(false));
    let on_signal = Arc::clone(&is_interrupted);
    ctrlc::set_handler(move || on_signal.store(true, Ordering::Relaxed))
        .map_err(|e| RunError::Run(format!("taking over Ctrl-C: {e}")))?;
    // What cannot be written is known before the work.
    let editor = MapStoreEditor::open_for_pages(map, plan.budget.store_capacity().page_bytes)?;
    let run_folder = RunFolder::of(map.folder());
    let tables: Vec<PathBuf> =
        views_csv.map(Path::to_owned).into_iter().chain(run_folder.as_ref().map(RunFolder::views_csv)).collect();
    let before = score(map, plan, &[], None)?;
    let training = train(map, plan, effort, editor, &mut || !is_interrupted.load(Ordering::Relaxed))?;
    let trained = MapStoreReader::open(map.folder(), plan.budget.capacity(Row::StoreKeyframeTable))?;
    let mut renders = run_folder.as_ref().map(|folder| folder.renders(&trained));
    let after = score(&trained, plan, &tables, renders.as_mut())?;
    if let Some((folder, renders)) = run_folder.zip(renders) {
        folder.update(&trained, &after, &renders.written())?;
    }
    Ok(RefineSummary { before, after, training })
}

/// What the map scores; what each view does goes into tables, and some are shown.
fn score(
    map: &MapStoreReader,
    plan: &RunPlan,
    tables: &[PathBuf],
    mut renders: Option<&mut Renders>,
) -> Result<Scores, RunError> {
    let mut backend = pipeline::backend(plan)?;
    let mut tables = tables.iter().map(|path| ViewTable::create(path)).collect::<Result<Vec<_>, _>>()?;
    let quality = judge_map(map, backend.as_mut(), &mut |view| {
        tables.iter_mut().try_for_each(|table| table.push(view))?;
        Ok(renders.as_mut().map_or(Ok(()), |renders| renders.push(view))?)
    })?;
    tables.into_iter().try_for_each(ViewTable::finish)?;
    Ok(Scores::new(map, &quality, map.bytes()?))
}

/// Trains and stores; `goes_on` is asked every few steps.
///
/// # Errors
/// [`RunError`] when the map cannot be stored, or the device refuses every step.
pub(super) fn train(
    map: &MapStoreReader,
    plan: &RunPlan,
    effort: Effort,
    editor: MapStoreEditor,
    goes_on: &mut dyn FnMut() -> bool,
) -> Result<TrainingCounts, RunError> {
    let bar = ProgressBar::new(BAR_TICKS).with_style(progress_style());
    let mut backend = pipeline::backend(plan)?;
    let mapper = &plan.settings.mapping.mapper;
    let n_exposures = if mapper.learned_exposure { backend.capacities().exposure_slots } else { usize::MAX };
    let images = StoredImages::new(map);
    let kept_bytes = plan.budget.capacity(Row::MapKeyframeImages) * crate::fit::ImageSource::bytes(&images);
    let mut memory = StretchMemory::new(map, backend.as_mut(), editor);
    let stretch_keyframes = memory.longest_stretch(plan.settings.lifecycle.stretch_keyframes.min(n_exposures));
    let mut trainer = Trainer {
        map,
        memory,
        images: TrainingImages::new(images, plan.camera, kept_bytes),
        step: mapper.step,
        lifecycle: plan.settings.lifecycle,
        limits: PruneLimits::of(mapper, &mapping_camera(&plan.camera, mapper.resolution)),
        measure: RouteMeasure::new(mapper.first_view_m, &plan.camera),
        coarse_resolution: mapper.resolution,
        learned_exposure: mapper.learned_exposure,
        clock: Clock::start(effort),
        seed: plan.seed,
        counts: TrainingCounts::default(),
        blind: BTreeSet::new(),
        on_progress: &mut |progress| {
            bar.set_position((progress.clamp(0.0, 1.0) * BAR_TICKS as f64) as u64);
            goes_on()
        },
    };
    trainer.run(&schedule::parts(map.keyframes().len(), stretch_keyframes))?;
    let counts = trainer.counts;
    warn_of_losses(&trainer);
    if counts.refused > 0 && counts.steps == 0 {
        return Err(RunError::Run(
            "refining the map: the compute device refuses every step; try --backend cpu".to_owned(),
        ));
    }
    trainer.memory.into_editor().finish()?;
    bar.finish_and_clear();
    Ok(counts)
}

fn progress_style() -> ProgressStyle {
    ProgressStyle::with_template("refining {bar:40} {percent} %, {elapsed}, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

fn warn_of_losses(trainer: &Trainer<'_>) {
    let losses = trainer.memory.losses();
    for (n, what) in [
        (losses.damaged_pages.len(), "pages cannot be read and are left as they are"),
        (losses.unstored_pages.len(), "pages have anchors that could not be loaded and are left as they are"),
        (losses.damaged_chunks.len(), "chunks cannot be read and are left as they are"),
        (trainer.blind.len(), "views have no usable picture and were not trained on"),
    ] {
        if n > 0 {
            log::warn!("{n} {what}");
        }
    }
}
