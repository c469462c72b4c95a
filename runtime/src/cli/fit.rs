//! `kilogs fit`: a map from images whose places are known.

use super::CommonArgs;
use crate::fit::{self, Effort, FitRequest, Scene, SceneRequest};
use crate::pipeline::RunPlan;
use crate::run_error::RunError;
use std::path::PathBuf;

/// Steps per view, unless told otherwise.
const DEFAULT_STEPS_PER_VIEW: u64 = 20;

/// Options of `kilogs fit`.
#[derive(Debug, Clone, clap::Args)]
#[command(
    after_help = "Examples:\n  kilogs fit ../shared/data/kitti04-full --poses ../shared/data/kitti04-full/poses.txt \
    --frames 60 --minutes 10 --out out/fit04\n  kilogs fit my_scene/transforms.json --iterations 2000 --out out/my_scene\n\n\
    Every eighth view is held out: it judges the map and is in no loss. Without --minutes the same input gives the \
    same bytes."
)]
pub struct FitArgs {
    /// nerfstudio's transforms.json or its folder, or a recording in the layout of KITTI odometry with --poses.
    /// Poses are in metres.
    pub scene: PathBuf,
    /// Folder for all outputs.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Poses of a recording in KITTI's format: 12 numbers of `world_from_camera` a line, one line per image.
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// With --poses: camera.toml, or the preset `kitti` (1.65 m over the road); the road's height helps the depth.
    #[arg(long, value_name = "FILE|kitti", requires = "poses")]
    pub camera: Option<String>,
    /// Take at most this many views.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(2..))]
    pub frames: Option<u64>,
    /// Training steps in all [default: 20 per view].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub iterations: Option<u64>,
    /// Train this long instead, insertion included; with --iterations whichever ends first.
    #[arg(long, value_name = "M", value_parser = minutes)]
    pub minutes: Option<f64>,
    /// Room for this many Gaussians in memory, instead of what the budget says.
    #[arg(long, value_name = "N")]
    pub max_gaussians: Option<usize>,
    /// What all mapping commands share.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Minutes to train, above 0.
pub(super) fn minutes(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(minutes) if minutes > 0.0 && minutes <= 1e5 => Ok(minutes),
        _ => Err(format!("\"{text}\" is not a number of minutes above 0")),
    }
}

/// Runs the command.
///
/// # Errors
/// [`RunError`].
pub fn run(args: &FitArgs) -> Result<(), RunError> {
    let frames = args.frames.map(|frames| usize::try_from(frames).unwrap_or(usize::MAX));
    let (poses, camera) = (args.poses.as_deref(), args.camera.as_deref());
    let scene = Scene::open(&SceneRequest { scene: &args.scene, poses, camera, frames })?;
    let plan = RunPlan::for_given_views(&args.common, scene.format(), &args.out, args.max_gaussians)?;
    let default_steps = DEFAULT_STEPS_PER_VIEW * scene.views.len() as u64;
    let effort = Effort::of(args.iterations, args.minutes, default_steps);
    fit::run(FitRequest { scene, plan, effort })
}
