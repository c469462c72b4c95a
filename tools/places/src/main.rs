//! `cargo run --release -p kilogs-places -- train|measure|close`: the vocabulary of place recognition, what it finds
//! on recordings, and what closing loops makes of their trajectories.

mod close;
mod drive;
mod error;
mod frames;
mod measure;
mod train;
mod tree;
mod verifier;

use clap::{Parser, Subcommand};
use std::process::ExitCode;

#[derive(Parser)]
#[command(name = "kilogs-places", about = "Trains the vocabulary of place recognition, and measures it")]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Sorts the features of recordings into words and writes them to a file.
    Train(train::TrainArgs),
    /// Drives through a recording with true poses and counts which places are recognized.
    Measure(measure::MeasureArgs),
    /// Drives through a recording with true poses, closes loops, and compares the trajectory with and without.
    Close(close::CloseArgs),
}

fn main() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Train(args) => train::run(&args),
        Command::Measure(args) => measure::run(&args),
        Command::Close(args) => close::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("kilogs-places: {error}");
            ExitCode::FAILURE
        }
    }
}

#[cfg(test)]
mod tests {
    use kilogs_core::places::Vocabulary;

    #[test]
    fn the_shipped_vocabulary_is_one() {
        let bytes = include_bytes!("../../../models/places.kgv");
        assert_eq!(Vocabulary::open(bytes).map(|vocabulary| vocabulary.n_words()), Ok(9989));
    }
}
