//! `cargo xtask bench pose-graph`: optimises pose graphs that `peers.py` beside this file stored, on one thread. Prints a
//! table and judges nothing.

#[path = "../tracking/clock.rs"]
mod clock;
mod graph_file;

use clap::Parser;
use clock::Times;
use graph_file::{GraphFile, Memory};
use kilogs_core::pose_graph::{Extent, Gauge, GraphCapacities, OptimizeSettings};
use std::error::Error;
use std::path::{Path, PathBuf};

#[derive(Parser)]
#[command(name = "cargo xtask bench pose-graph", about = "Optimises stored pose graphs on one thread")]
struct Options {
    /// Graphs that peers.py stored.
    #[arg(required = true, value_name = "GRAPH.txt")]
    graphs: Vec<PathBuf>,
    /// Times that each graph is optimised.
    #[arg(long, default_value_t = 10)]
    rounds: usize,
    /// Most nodes of the skeleton; a longer drive is thinned.
    #[arg(long, default_value_t = 8192)]
    nodes: usize,
    /// Most loops.
    #[arg(long, default_value_t = 512)]
    loops: usize,
    /// Most blocks of the factor.
    #[arg(long, default_value_t = 8192)]
    blocks: usize,
    /// Lies among the loops: every so many-th is moved by 30 m.
    #[arg(long, value_name = "N")]
    lie_every: Option<usize>,
    /// Given by `cargo bench`.
    #[arg(long, hide = true)]
    bench: bool,
}

const SETTINGS: OptimizeSettings = OptimizeSettings {
    gauge: Gauge::First,
    extent: Extent::Whole,
    is_scale_free: true,
    max_loop_sigmas: 6.0,
    max_iterations: 50,
};

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse();
    let capacities = GraphCapacities { nodes: options.nodes, loops: options.loops, blocks: options.blocks };
    println!("{capacities:?}: {:.1} MiB\n", capacities.bytes() as f64 / f64::from(1 << 20));
    println!("| graph | nodes | loops (rejected) | ATE before, m | after, m | cost after | blocks | steps | ms |");
    println!("|---|---|---|---|---|---|---|---|---|");
    for path in &options.graphs {
        print_row(path, &capacities, &options)?;
    }
    println!("\nms: processor time of one thread, median (fastest). ATE after Sim(3) alignment.");
    Ok(())
}

fn print_row(path: &Path, capacities: &GraphCapacities, options: &Options) -> Result<(), Box<dyn Error>> {
    let file = GraphFile::read(path)?;
    let mut memory: Vec<Memory> = (0..options.rounds.max(1)).map(|_| Memory::new(capacities)).collect();
    let mut parts = Vec::new();
    for (graph, work) in memory.iter_mut().map(Memory::split) {
        let mut graph = graph;
        file.fill(&mut graph, options.lie_every)?;
        parts.push((graph, work));
    }
    let before_m = file.ate_m(&parts[0].0);
    let mut outcome = None;
    let times = Times::of(0..parts.len(), |round| {
        let (graph, work) = &mut parts[round];
        outcome = Some(graph.optimize(&SETTINGS, work));
    });
    let Some(report) = outcome.transpose()? else { return Ok(()) };
    let graph = &parts[0].0;
    println!(
        "| {} | {} | {} ({}) | {before_m:.3} | {:.3} | {:.2} | {} | {} | {} |",
        path.display(),
        graph.n_nodes(),
        graph.loops().count(),
        report.n_rejected,
        file.ate_m(graph),
        report.cost_after,
        report.n_blocks,
        report.n_iterations,
        times.text(),
    );
    Ok(())
}
