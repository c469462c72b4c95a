//! `cargo xtask sequences`: replays recordings and simulated drives and prints tables of what came out.

mod bench;
mod overview;
mod tracking;

use crate::step::StepFailed;
use bench::{Bench, read_json};
use std::path::{Path, PathBuf};

/// Options of `cargo xtask sequences`.
#[derive(Debug, clap::Args)]
pub(crate) struct SequencesArgs {
    #[command(subcommand)]
    table: Table,
}

#[derive(Debug, clap::Subcommand)]
enum Table {
    /// A line per recording: tracked and mapped, with memory and time.
    Overview(overview::OverviewArgs),
    /// What each part of the tracker is worth: every recording with parts of it switched off, and drives that are spoilt.
    Tracking(tracking::TrackingArgs),
}

/// What all tables share.
#[derive(Debug, clap::Args)]
struct CommonArgs {
    /// Only recordings and drives whose name contains this.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// At most this many frames of each.
    #[arg(long, value_name = "N")]
    frames: Option<u32>,
    /// Folder of the recordings; the default is $KILOGS_DATA, then ../shared/data.
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// The program to use, instead of a release binary that is built first.
    #[arg(long, value_name = "PATH")]
    kilogs: Option<PathBuf>,
}

/// Prints one of the tables.
pub(crate) fn run(root: &Path, args: &SequencesArgs) -> Result<(), StepFailed> {
    match &args.table {
        Table::Overview(args) => overview::run(root, args),
        Table::Tracking(args) => tracking::run(root, args),
    }
}
