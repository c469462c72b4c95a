//! `kilogs budget`: prints the memory plan.

use super::{Budget, MappingPlan, Plan, PlanInput};
use crate::compute::{BackendChoice, Compute};
use crate::run_error::RunError;
use crate::settings::Settings;
use crate::splat::kernel_constants::MAX_IMAGE_SIDE_PX;
use std::ops::RangeInclusive;
use std::path::PathBuf;

/// Options of `kilogs budget`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Example:\n  kilogs budget --check --size 1241x376 --pixel-bytes 1")]
pub struct BudgetArgs {
    /// Budget file, or the name of a built-in profile (memory_budget.toml, 1080p-2gib.toml, tiny.toml).
    #[arg(long, value_name = "FILE")]
    pub budget: Option<PathBuf>,
    /// Only say whether the plan fits: nothing on success, the reason and exit code 2 otherwise.
    #[arg(long)]
    pub check: bool,
    /// What the camera delivers.
    #[command(flatten)]
    pub camera: PlanCameraArgs,
}

/// The camera and the compute device to plan for.
#[derive(Debug, Clone, clap::Args)]
pub struct PlanCameraArgs {
    /// Width and height of the camera's image, px.
    #[arg(long, value_name = "WxH", default_value = "1241x376", value_parser = parse_size)]
    pub size: (u32, u32),
    /// Bytes of a pixel on the wire: 1 for grey, 3 for color.
    #[arg(long, value_name = "N", default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=4))]
    pub pixel_bytes: u32,
    /// What computes the map.
    #[arg(long, value_enum, default_value_t = BackendChoice::Auto)]
    pub backend: BackendChoice,
    /// Number of the Vulkan device, as `kilogs doctor` lists them.
    #[arg(long, value_name = "N")]
    pub device: Option<u32>,
}

impl PlanCameraArgs {
    /// What the plan has to know.
    ///
    /// # Errors
    /// [`RunError::Device`] when a device was asked for that cannot be had.
    pub fn plan_input(&self, settings: &Settings) -> Result<PlanInput, RunError> {
        let (width, height) = self.size;
        let compute = Compute::choose(self.backend, self.device)?.memory();
        Ok(PlanInput {
            width,
            height,
            frame_bytes: u64::from(width) * u64::from(height) * u64::from(self.pixel_bytes),
            color_channels: if self.pixel_bytes == 1 { 1 } else { 3 },
            mapping: MappingPlan::of(&settings.mapping.mapper, width),
            compute,
            has_networks: settings.has_networks(),
            has_loops: settings.loop_closure.enabled,
        })
    }
}

/// Sides that an image can have, px.
const SIDES_PX: RangeInclusive<u32> = 16..=MAX_IMAGE_SIDE_PX;

fn parse_size(text: &str) -> Result<(u32, u32), String> {
    let sides = text.split_once('x').and_then(|(w, h)| Some((w.parse::<u32>().ok()?, h.parse::<u32>().ok()?)));
    match sides {
        Some((width, height)) if SIDES_PX.contains(&width) && SIDES_PX.contains(&height) => Ok((width, height)),
        _ => Err(format!(
            "write width and height in pixels, {} to {} each, such as 1241x376",
            SIDES_PX.start(),
            SIDES_PX.end()
        )),
    }
}

/// Prints the plan, then refuses one that does not fit.
///
/// # Errors
/// [`RunError`] for a file or a device that cannot be used, and for a plan above its cap.
pub fn run(args: &BudgetArgs, settings: &Settings) -> Result<(), RunError> {
    let budget = Budget::load(args.budget.as_deref())?;
    let plan = Plan::compute(&budget, &args.camera.plan_input(settings)?);
    if !args.check {
        kilogs_eval::stdout::show(&format!("{plan}\n")).map_err(RunError::stdout)?;
    }
    Ok(plan.check()?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_two_sane_numbers() {
        assert_eq!(parse_size("1241x376"), Ok((1241, 376)));
        for wrong in ["", "1241", "1241x", "x376", "0x376", "99999x3", "4097x100", "-5x20", "12.5x20"] {
            assert!(parse_size(wrong).is_err(), "{wrong}");
        }
    }
}
