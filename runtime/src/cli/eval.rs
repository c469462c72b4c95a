//! `kilogs eval`: judges an output folder, its map by a network too where one is installed.

use super::{CommonArgs, map_commands};
use crate::budget::Row;
use crate::inference::{Manifest, ModelError, Role, open_lpips};
use crate::map_store::MapStoreReader;
use crate::render_views::command::RenderError;
use crate::render_views::measure_lpips;
use crate::run_error::RunError;
use kilogs_eval::{EvalArgs, LpipsFigures};
use std::path::Path;

/// Options of `kilogs eval`.
#[derive(Debug, Clone, clap::Args)]
pub struct EvalCommand {
    #[command(flatten)]
    pub args: EvalArgs,
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Runs the command.
///
/// # Errors
/// [`RunError`].
pub fn run(args: &EvalArgs, common: &CommonArgs) -> Result<(), RunError> {
    let models = common.settings()?.inference.models;
    let measure = || {
        lpips(&args.dir.join("map"), &models, common).unwrap_or_else(|problem| {
            log::warn!("LPIPS is left out: {problem}");
            LpipsFigures::default()
        })
    };
    Ok(kilogs_eval::run(args, measure)?)
}

/// Compares every view of a map by the network that is installed for its pictures; nothing without a map or a network.
fn lpips(map: &Path, models: &Path, common: &CommonArgs) -> Result<LpipsFigures, RunError> {
    let networks = match Manifest::find(models) {
        Err(ModelError::NoFolder { .. }) if models.as_os_str().is_empty() => return Ok(LpipsFigures::default()),
        found => found.map_err(RenderError::from)?,
    };
    if networks.of_role(Role::Lpips).next().is_none() || !map.is_dir() {
        return Ok(LpipsFigures::default());
    }
    let budget = common.budget()?;
    let map = MapStoreReader::open(map, budget.capacity(Row::StoreKeyframeTable))?;
    let camera = map.manifest().camera;
    let size = (camera.width as usize, camera.height as usize);
    let mut lpips = open_lpips(&networks, size).map_err(RenderError::from)?;
    let mut backend = map_commands::backend(common, &budget, &map)?;
    Ok(measure_lpips(&map, backend.as_mut(), &mut lpips)?)
}
