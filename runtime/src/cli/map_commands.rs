//! `kilogs render` and `kilogs export`: commands on a stored map.

use crate::budget::{Budget, Row};
use crate::export::{self, ExportArgs};
use crate::map_store::MapStoreReader;
use crate::render_views::command::{self, RenderArgs};
use crate::run_error::RunError;
use crate::splat::Capacities;
use crate::splat::cpu::{CpuBackend, SimdLevel};
use std::path::PathBuf;

/// Options of `kilogs render`.
#[derive(Debug, Clone, clap::Args)]
pub struct RenderCommand {
    #[command(flatten)]
    args: RenderArgs,
    /// Memory budget file, or the name of a built-in profile.
    #[arg(long, value_name = "FILE")]
    budget: Option<PathBuf>,
}

/// Options of `kilogs export`.
#[derive(Debug, Clone, clap::Args)]
pub struct ExportCommand {
    #[command(flatten)]
    args: ExportArgs,
    /// Memory budget file, or the name of a built-in profile.
    #[arg(long, value_name = "FILE")]
    budget: Option<PathBuf>,
}

/// Runs `kilogs render`.
///
/// # Errors
/// [`RunError`].
pub fn render(command: &RenderCommand) -> Result<(), RunError> {
    let budget = Budget::load(command.budget.as_deref())?;
    let map = command::open(&command.args, budget.capacity(Row::StoreKeyframeTable))?;
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
    let backend = CpuBackend::new(capacities(&budget, &map), threads, SimdLevel::best(), |_| ());
    let mut backend = backend.map_err(|e| RunError::Device(e.to_string()))?;
    let n_views = command::run(&command.args, &map, &mut backend)?;
    log::info!("{n_views} views rendered to {}", command.args.out.display());
    Ok(())
}

/// Runs `kilogs export`.
///
/// # Errors
/// [`RunError`].
pub fn export(command: &ExportCommand) -> Result<(), RunError> {
    let budget = Budget::load(command.budget.as_deref())?;
    let summary = export::run(&command.args, budget.capacity(Row::StoreKeyframeTable))?;
    log::debug!("{summary:?}");
    Ok(())
}

fn capacities(budget: &Budget, map: &MapStoreReader) -> Capacities {
    let camera = map.manifest().camera;
    let anchors = budget.capacity(Row::MapAnchors);
    let gaussians = map.manifest().gaussians_per_anchor as usize;
    Capacities {
        keyframe_rows: budget.capacity(Row::MapKeyframes),
        chunk_rows: budget.capacity(Row::MapChunks),
        // Nothing is trained here.
        training_pixels: 1,
        learned_decoder: map.has_learned_decoder(),
        ..Capacities::for_map(anchors, gaussians, camera.width, camera.height)
    }
}
