//! `kilogs demo`: the main job with nothing but this binary.

use super::CommonArgs;
use super::replay::DEFAULT_ITERATIONS;
use crate::input::CameraChild;
use crate::pipeline::{self, Pace, RunPlan};
use crate::run_error::RunError;
use kilogs_camera::sim::{SimArgs, Simulator, parse_length};
use kilogs_camera::source::{DegradeArgs, FrameSource};
use std::path::PathBuf;

/// Options of `kilogs demo`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Examples:\n  kilogs demo --out out/demo\n  then open out/demo/report.html\n  \
    kilogs demo --degrade tunnel@100..140 --out out/dark")]
pub struct DemoArgs {
    /// Folder for all outputs.
    #[arg(long, value_name = "DIR", default_value = "out/demo")]
    pub out: PathBuf,
    /// Length of the simulated drive, m.
    #[arg(long, value_name = "METRES", default_value_t = 320.0, value_parser = parse_length)]
    pub length: f64,
    /// Mapping iterations per keyframe.
    #[arg(long, default_value_t = DEFAULT_ITERATIONS, value_name = "N")]
    pub iterations: u32,
    /// What is done to the frames.
    #[command(flatten)]
    pub degrade: DegradeArgs,
    /// What all tracking commands share.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Runs the command.
///
/// # Errors
/// [`RunError`].
pub fn run(args: &DemoArgs) -> Result<(), RunError> {
    // Seed 0 of the run is the town that the documentation shows.
    let sim = SimArgs { length: args.length, seed: args.common.seed.wrapping_add(1), ..SimArgs::default() };
    let format = Simulator::new(&sim).map_err(|e| RunError::Input(e.to_string()))?.format();
    args.degrade.check(format.n_frames)?;
    let plan = RunPlan::new(&args.common, format, Pace::LockStep { iterations: args.iterations }, &args.out)?;
    let truth = args.out.join("truth");
    pipeline::run_with_child(plan, |service| {
        let (seed, length, truth) = (sim.seed.to_string(), sim.length.to_string(), truth.display().to_string());
        let words =
            ["camera", "sim", "--quiet", "--service", service, "--seed", &seed, "--length", &length, "--truth", &truth];
        CameraChild::start(words.into_iter().map(str::to_owned).chain(args.degrade.to_words()))
    })?;
    let judged = kilogs_eval::EvalArgs { dir: args.out.clone(), gt: truth.join("poses.txt"), dataset: None };
    super::eval::run(&judged, &args.common)
}
