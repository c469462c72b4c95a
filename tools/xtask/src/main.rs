//! Developer commands: `cargo xtask test`, `cargo xtask guards`, `cargo xtask bench`, `cargo xtask sequences`.

mod bench;
mod guards;
mod sequences;
mod setup;
mod step;
mod test;

use clap::{Parser, Subcommand};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

#[derive(Parser)]
#[command(name = "cargo xtask", about = "Developer commands of KiloGS", after_help = "Example:\n  cargo xtask test")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Installs what tests need and runs every check: what CI runs.
    Test,
    /// Only the rules of the workspace that no compiler checks.
    Guards,
    /// Prints tables of times; asserts nothing.
    Bench(bench::BenchArgs),
    /// Replays the recordings and prints a table of figures; writes nothing into the repository.
    Sequences(sequences::SequencesArgs),
}

/// The root of the workspace.
pub(crate) fn workspace_root() -> PathBuf {
    let manifest_dir = Path::new(env!("CARGO_MANIFEST_DIR"));
    manifest_dir.ancestors().nth(2).unwrap_or(manifest_dir).to_owned()
}

fn main() -> ExitCode {
    let root = workspace_root();
    let result = match Cli::parse().command {
        Command::Test => test::run(&root),
        Command::Guards => test::guards(&root),
        Command::Bench(args) => bench::run(&root, &args),
        Command::Sequences(args) => sequences::run(&root, &args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failed) => {
            eprintln!("xtask: {failed}");
            ExitCode::FAILURE
        }
    }
}
