//! `kilogs render` and `kilogs export`: commands on a stored map.

use super::{CommonArgs, UnusedArgs};
use crate::budget::{Budget, ComputeMemory, HumanBytes, MappingPlan, PlanInput, Row};
use crate::compute::BackendPlan;
use crate::export::{self, ExportArgs};
use crate::map_store::MapStoreReader;
use crate::render_views::command::{self, RenderArgs};
use crate::run_error::RunError;
use crate::splat::cpu::CpuBackend;
use crate::splat::{Capacities, SplatBackend};
use std::path::PathBuf;

/// Options of `kilogs render`.
#[derive(Debug, Clone, clap::Args)]
pub struct RenderCommand {
    #[command(flatten)]
    args: RenderArgs,
    #[command(flatten)]
    common: CommonArgs,
}

/// Options of `kilogs export`.
#[derive(Debug, Clone, clap::Args)]
pub struct ExportCommand {
    #[command(flatten)]
    args: ExportArgs,
    /// Memory budget file, or the name of a built-in profile.
    #[arg(long, value_name = "FILE")]
    budget: Option<PathBuf>,
    #[command(flatten)]
    unused: UnusedArgs,
}

/// Runs `kilogs render`.
///
/// # Errors
/// [`RunError`].
pub fn render(command: &RenderCommand) -> Result<(), RunError> {
    let common = &command.common;
    let budget = common.budget()?;
    common.settings()?;
    let map = command::open(&command.args, budget.capacity(Row::StoreKeyframeTable))?;
    let mut backend = backend(common, &budget, &map)?;
    let n_views = command::run(&command.args, &map, backend.as_mut())?;
    log::info!("{n_views} views rendered to {}", command.args.out.display());
    Ok(())
}

/// What draws a map.
///
/// # Errors
/// [`RunError`] when a device cannot be had, or the budget does not grant enough.
pub(super) fn backend(
    common: &CommonArgs,
    budget: &Budget,
    map: &MapStoreReader,
) -> Result<Box<dyn SplatBackend>, RunError> {
    let (compute, simd) = (common.compute()?, common.simd()?);
    let capacities = capacities(budget, map, compute.memory());
    check_memory(budget, &capacities)?;
    let arena_cap_bytes = match compute.memory() {
        ComputeMemory::OwnDevice => budget.device_bytes(),
        ComputeMemory::Cpu | ComputeMemory::SharedDevice => budget.host_bytes(),
    };
    let n_threads = common.n_threads(false);
    compute.open(&BackendPlan { capacities, arena_cap_bytes, has_substitute: true, n_threads, simd })
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

/// What the budget grants, for the map's own Gaussians and pictures.
fn capacities(budget: &Budget, map: &MapStoreReader, compute: ComputeMemory) -> Capacities {
    let manifest = map.manifest();
    let input = PlanInput {
        width: manifest.camera.width,
        height: manifest.camera.height,
        frame_bytes: 0,
        color_channels: 3,
        mapping: MappingPlan {
            resolution: 1.0,
            window: 1,
            learned_decoder: map.has_learned_decoder(),
            trains_depth: false,
        },
        compute,
        has_networks: false,
        has_loops: false,
    };
    Capacities {
        gaussians_per_anchor: manifest.gaussians_per_anchor as usize,
        // Nothing is trained here.
        training_pixels: 1,
        exposure_slots: 1,
        ..budget.splat_capacities(&input)
    }
}

/// Drawing takes only the backend's part of a plan: it has to fit the whole cap.
fn check_memory(budget: &Budget, capacities: &Capacities) -> Result<(), RunError> {
    let needed =
        CpuBackend::memory_plan(capacities).iter().fold(0, |sum: u64, row| sum.saturating_add(row.bytes() as u64));
    if needed <= budget.host_bytes() {
        return Ok(());
    }
    Err(RunError::Usage(format!(
        "drawing the map: its pictures and the lists of {} take {}, [total] host_bytes is {}; lower [map.anchors] and \
         [splat.*], or raise host_bytes",
        budget.file(),
        HumanBytes(needed),
        HumanBytes(budget.host_bytes())
    )))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::budget::PROFILES;

    #[test]
    fn lists_that_take_more_than_the_cap_are_refused() {
        let check = |host_bytes: &str, code: Option<u8>| {
            let text = PROFILES[0].1.replace("host_bytes = \"512 MiB\"", &format!("host_bytes = \"{host_bytes}\""));
            let budget = Budget::parse(&text, "my.toml").expect("a possible budget");
            let capacities = Capacities::for_map(131_072, 2, 1241, 376);
            let verdict = check_memory(&budget, &capacities);
            assert_eq!(verdict.as_ref().map_err(RunError::code).err(), code, "{host_bytes}: {verdict:?}");
        };
        check("512 MiB", None);
        check("16 MiB", Some(2));
    }
}
