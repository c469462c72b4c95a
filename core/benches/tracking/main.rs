//! `cargo xtask bench tracking`: times the parts of the tracker on one thread, with what they get right. Prints tables
//! and judges nothing. `peers.py` beside this file runs OpenCV and PoseLib on the same problems.

mod clock;
mod geometry;
mod images;
mod matching;
mod pictures;
mod problems;

use clap::Parser;
use pictures::Pair;
use std::path::PathBuf;

#[derive(Parser)]
#[command(name = "cargo xtask bench tracking", about = "Times the parts of the tracker on one thread")]
struct Options {
    /// Folder shared with peers.py: its two pictures are read, all problems are written. Without it, pictures are made up.
    #[arg(long, value_name = "DIR")]
    folder: Option<PathBuf>,
    /// Only tables whose name contains this: images, matching, essential, homography, pnp or bundle.
    #[arg(long, value_name = "TEXT", default_value = "")]
    only: String,
    /// Problems per robust estimation.
    #[arg(long, default_value_t = 200)]
    seeds: u64,
    /// Repetitions of everything else.
    #[arg(long, default_value_t = 30)]
    rounds: usize,
    /// Given by `cargo bench`.
    #[arg(long, hide = true)]
    bench: bool,
}

fn main() -> std::io::Result<()> {
    let options = Options::parse();
    let recorded = match &options.folder {
        Some(folder) => Pair::stored(folder)?,
        None => Pair::invented(),
    };
    if let Some(folder) = &options.folder {
        images::store(&recorded, folder)?;
        geometry::store(options.seeds, folder)?;
    }
    println!("Milliseconds of one thread: median (fastest).\n");
    let wanted = |name: &str| name.contains(&options.only);
    if wanted("images") {
        images::print_table(&recorded, options.rounds);
    }
    if wanted("matching") {
        matching::print_times(&recorded, options.rounds);
        matching::print_errors(&recorded);
    }
    if wanted("essential") {
        geometry::print_essential(options.seeds);
    }
    if wanted("homography") {
        geometry::print_homography(options.seeds);
    }
    if wanted("pnp") {
        geometry::print_pnp(options.seeds);
    }
    if wanted("bundle") {
        geometry::print_bundle(options.rounds);
    }
    Ok(())
}

/// The median of numbers in any order.
pub fn median(mut values: Vec<f64>) -> f64 {
    values.sort_unstable_by(f64::total_cmp);
    clock::middle(&values)
}
