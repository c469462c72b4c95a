//! `kilogs refine`: a stored map, improved in place.

use super::CommonArgs;
use super::fit::minutes;
use crate::budget::Row;
use crate::export::map_folder;
use crate::fit::Effort;
use crate::map_store::MapStoreReader;
use crate::pipeline::RunPlan;
use crate::refine::{self, RefineRequest};
use crate::run_error::RunError;
use std::path::PathBuf;

/// Steps per keyframe, unless told otherwise.
const DEFAULT_STEPS_PER_KEYFRAME: u64 = 20;

/// Options of `kilogs refine`.
#[derive(Debug, Clone, clap::Args)]
#[command(
    after_help = "Examples:\n  kilogs refine out/04/map --minutes 20\n  kilogs refine out/04 --iterations 2000\n\n\
    The map is trained stretch by stretch on its own pictures, except those held out, in the memory of the budget. What \
    is finished is stored at once, so Ctrl-C or a lost machine costs one stretch. Without --minutes the same map gives \
    the same bytes."
)]
pub struct RefineArgs {
    /// Folder of the map (the one with manifest.kgs), or of the run that holds it.
    pub map: PathBuf,
    /// Training steps in all [default: 20 per keyframe].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub iterations: Option<u64>,
    /// Train this long instead, or until --iterations are done; judging the map before and after is not counted.
    #[arg(long, value_name = "M", value_parser = minutes)]
    pub minutes: Option<f64>,
    /// Table of what each view scores afterwards: chunk, metres driven, PSNR, SSIM.
    #[arg(long, value_name = "FILE")]
    pub views: Option<PathBuf>,
    /// What all mapping commands share.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Runs the command.
///
/// # Errors
/// [`RunError`].
pub fn run(args: &RefineArgs) -> Result<(), RunError> {
    let budget = args.common.budget()?;
    let map = MapStoreReader::open(&map_folder(&args.map), budget.capacity(Row::StoreKeyframeTable))?;
    for damage in map.damages() {
        log::warn!("{}: left as it is: {damage}", args.map.display());
    }
    let plan = RunPlan::for_stored_map(&args.common, &budget, &map)?;
    let default_steps = DEFAULT_STEPS_PER_KEYFRAME * map.keyframes().len() as u64;
    let effort = Effort::of(args.iterations, args.minutes, default_steps);
    let summary = refine::run(&RefineRequest { map: &map, plan: &plan, effort, views_csv: args.views.as_deref() })?;
    kilogs_eval::stdout::show(&summary.to_string()).map_err(RunError::stdout)
}
