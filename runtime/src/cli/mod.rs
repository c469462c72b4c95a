//! The command line of `kilogs`.

mod common;
mod demo;
mod eval;
mod fit;
mod map_commands;
mod refine;
mod replay;
mod run;

pub use common::{CommonArgs, ResumeArgs, UnusedArgs, UnusedKernelArgs};

use crate::run_error::RunError;
use clap::{Parser, Subcommand};
use kilogs_camera::cli::CameraArgs;

/// Monocular 3D-Gaussian-splatting SLAM for vehicles, inside a memory budget fixed before the start.
#[derive(Debug, Parser)]
#[command(name = "kilogs", version, max_term_width = 110)]
#[command(
    after_help = "Examples:\n  kilogs demo\n  kilogs replay ../shared/data/kitti04-full --camera kitti --out out/04\n\n\
    Exit codes: 0 success, 1 run failed, 2 usage, configuration or budget, 3 input, 4 compute device, 5 map store.\n\
    Logs go to stderr; RUST_LOG=debug shows more."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Drive a built-in simulated street: track it, map it, write all outputs. Needs no GPU, data or network.
    Demo(demo::DemoArgs),
    /// Play a recorded sequence through a capture process, track and map it.
    Replay(replay::ReplayArgs),
    /// Attach to a live camera service, track and map until Ctrl-C or the end of the stream.
    Run(run::RunArgs),
    /// Train a map from images whose places are known.
    Fit(fit::FitArgs),
    /// Improve a stored map in place.
    Refine(refine::RefineArgs),
    /// Judge an output folder against ground truth.
    Eval(eval::EvalCommand),
    /// Render views of a stored map.
    Render(map_commands::RenderCommand),
    /// Write a stored map as standard Gaussian-splatting files.
    Export(map_commands::ExportCommand),
    /// Print the memory plan.
    Budget(BudgetCommand),
    /// Check devices, shared memory, budget and models; each with ok or what to do.
    Doctor(DoctorCommand),
    /// The capture process, as `replay` and `demo` start it in a child of their own.
    #[command(hide = true)]
    Camera(CameraArgs),
}

#[derive(Debug, clap::Args)]
struct BudgetCommand {
    #[command(flatten)]
    args: crate::budget::BudgetArgs,
    #[command(flatten)]
    config: crate::config::ConfigArgs,
    #[command(flatten)]
    unused: UnusedKernelArgs,
}

#[derive(Debug, clap::Args)]
struct DoctorCommand {
    #[command(flatten)]
    args: crate::doctor::DoctorArgs,
    #[command(flatten)]
    config: crate::config::ConfigArgs,
    #[command(flatten)]
    unused: UnusedKernelArgs,
}

/// Parses the command line and runs its command.
///
/// # Errors
/// [`RunError`] with the exit code in it; usage errors of the parser itself exit at once with code 2.
pub fn main() -> Result<(), RunError> {
    let cli = Cli::parse();
    match &cli.command {
        Command::Demo(args) => demo::run(args),
        Command::Replay(args) => replay::run(args),
        Command::Run(args) => run::run(args),
        Command::Fit(args) => fit::run(args),
        Command::Refine(args) => refine::run(args),
        Command::Eval(command) => eval::run(&command.args, &command.common),
        Command::Render(command) => map_commands::render(command),
        Command::Export(command) => map_commands::export(command),
        Command::Budget(command) => {
            let settings = crate::config::load(&command.config)?;
            crate::budget::run(&command.args, &settings)
        }
        Command::Doctor(command) => {
            let settings = crate::config::load(&command.config)?;
            crate::doctor::run(&command.args, &settings)
        }
        Command::Camera(args) => Ok(kilogs_camera::cli::run(args)?),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent_and_every_command_shows_an_example() {
        Cli::command().debug_assert();
        for command in Cli::command().get_subcommands().filter(|c| !c.is_hide_set()) {
            let help = command.clone().render_long_help().to_string();
            assert!(help.contains("Example"), "{} has no example in its help", command.get_name());
        }
    }

    #[test]
    fn every_command_takes_the_options_that_scripts_give_to_all() {
        const COMMANDS: [&[&str]; 10] = [
            &["demo"],
            &["replay", "drive", "--out", "o"],
            &["run", "--service", "s", "--camera", "c.toml", "--out", "o"],
            &["fit", "scene", "--out", "o"],
            &["refine", "map"],
            &["eval", "o", "--gt", "poses.txt"],
            &["render", "map", "--trajectory", "t.txt", "--out", "o"],
            &["export", "map", "--ply", "f.ply"],
            &["budget"],
            &["doctor"],
        ];
        const OPTIONS: [&str; 18] = [
            "--config",
            "c.toml",
            "--set",
            "a=b",
            "--budget",
            "b.toml",
            "--backend",
            "cpu",
            "--device",
            "0",
            "--simd",
            "avx2",
            "--threads",
            "2",
            "--seed",
            "3",
            "--set",
            "c=d",
        ];
        for command in COMMANDS {
            let parsed = Cli::try_parse_from([&["kilogs"][..], command, &OPTIONS].concat());
            assert!(parsed.is_ok(), "{command:?}: {}", parsed.map(|_| ()).unwrap_err());
        }
    }
}
