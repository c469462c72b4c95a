//! `cargo xtask bench NAME`: builds a benchmark in release and hands it the options after `--`.

use crate::step::{StepFailed, run as step};
use std::path::Path;

/// Options of `cargo xtask bench`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  cargo xtask bench splat -- --size 50k --backend avx512")]
pub(crate) struct BenchArgs {
    /// What to time.
    #[arg(value_enum)]
    name: BenchName,
    /// Options handed on to the benchmark, after `--`; `-- --help` lists them.
    #[arg(last = true)]
    more: Vec<String>,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum BenchName {
    /// A training step of every splatting backend, stage by stage.
    Splat,
    /// The parts of the tracker: corners, tracks, poses, bundle adjustment.
    Tracking,
    /// The pose graph, on graphs stored by core/benches/pose_graph/peers.py.
    PoseGraph,
}

/// Runs one benchmark; its tables go to stdout.
pub(crate) fn run(root: &Path, args: &BenchArgs) -> Result<(), StepFailed> {
    let (package, name) = match args.name {
        BenchName::Splat => ("kilogs", "splat"),
        BenchName::Tracking => ("kilogs-core", "tracking"),
        BenchName::PoseGraph => ("kilogs-core", "pose_graph"),
    };
    let mut arguments = vec!["bench", "--quiet", "--package", package, "--bench", name, "--"];
    arguments.extend(args.more.iter().map(String::as_str));
    step(root, "benchmark", "cargo", &arguments, &[])
}
