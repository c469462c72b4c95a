//! `cargo xtask sequences`: replays recordings and simulated drives and prints tables of what came out.

mod bench;
mod jobs;
mod loops;
mod mapping;
mod overview;
mod table;
mod tracking;

use crate::step::StepFailed;
use bench::{Bench, read_json};
use jobs::run_all;
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
    /// What each part of the mapper is worth: every recording with parts of it exchanged, as mapped and refined.
    Mapping(mapping::MappingArgs),
    /// What closing loops is worth: a simulated town, every recording, and drives with five seconds cut out.
    Loops(loops::LoopsArgs),
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

/// What tables with arms share.
#[derive(Debug, clap::Args)]
struct ArmArgs {
    /// Only arms whose name contains one of these, between commas.
    #[arg(long, value_name = "TEXT", value_delimiter = ',')]
    arms: Vec<String>,
    /// Runs at once. Times are only worth something with one.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    jobs: u16,
}

impl ArmArgs {
    fn is_wanted(&self, arm: &str) -> bool {
        self.arms.is_empty() || self.arms.iter().any(|text| arm.contains(text.as_str()))
    }

    /// What has to be said about times.
    fn warning(&self) -> Option<String> {
        (self.jobs > 1).then(|| format!("{} runs at once: times are those of a busy machine.", self.jobs))
    }
}

/// Prints one of the tables.
pub(crate) fn run(root: &Path, args: &SequencesArgs) -> Result<(), StepFailed> {
    match &args.table {
        Table::Overview(args) => overview::run(root, args),
        Table::Tracking(args) => tracking::run(root, args),
        Table::Mapping(args) => mapping::run(root, args),
        Table::Loops(args) => loops::run(root, args),
    }
}
