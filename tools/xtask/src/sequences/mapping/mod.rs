//! `cargo xtask sequences mapping`: what each part of the mapper is worth, as mapped and refined.

mod figures;

use super::{ArmArgs, Bench, CommonArgs, read_json, run_all};
use crate::step::StepFailed;
use figures::Figures;
use std::fmt::Write as _;
use std::path::Path;

/// Recordings in the order of the table.
const RECORDINGS: [&str; 3] = ["kitti00-0000-1699", "kitti04-full", "kitti00-lowres-colour-0000-1017"];

/// What is exchanged: name and settings, which both mapping and refining get. Every arm inserts by the same quota.
const ARMS: [(&str, &[&str]); 12] = [
    ("ours", &[]),
    ("insertion: random", &["mapping.insertion=random"]),
    ("insertion: Canny", &["mapping.insertion=canny"]),
    ("insertion: LoG", &["mapping.insertion=log"]),
    ("insertion: no depth gradient", &["mapping.insertion_depth_edge_weight=0"]),
    ("insertion: no NMS", &["mapping.insertion_suppression=false"]),
    ("lifecycle: densify", &["lifecycle.densify=true"]),
    ("lifecycle: prune, error-weighted", &["lifecycle.prune=true"]),
    ("lifecycle: prune, paper", &["lifecycle.prune=true", "lifecycle.score=paper"]),
    ("lifecycle: densify, prune, error-weighted", &["lifecycle.densify=true", "lifecycle.prune=true"]),
    ("lifecycle: densify, prune, paper", &["lifecycle.densify=true", "lifecycle.prune=true", "lifecycle.score=paper"]),
    ("decoder: learned per chunk", &["mapping.decoder=learned"]),
];

/// Options of `cargo xtask sequences mapping`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  cargo xtask sequences mapping --frames 150 --iterations 4\n  \
                  cargo xtask sequences mapping --only kitti04 --frames 80 --arms ours,insertion --jobs 2\n  \
                  cargo xtask sequences mapping --frames 150 --arms lifecycle --kilogs target/release/kilogs")]
pub(super) struct MappingArgs {
    /// What all tables share.
    #[command(flatten)]
    common: CommonArgs,
    /// Which arms, and how many at once.
    #[command(flatten)]
    arms: ArmArgs,
    /// Training steps per keyframe while mapping.
    #[arg(long, default_value_t = 10, value_name = "N")]
    iterations: u32,
    /// Training steps per keyframe while refining; 0 leaves it out.
    #[arg(long, default_value_t = 10, value_name = "N")]
    refine: u32,
}

/// Prints the table on stdout. Output folders go below `target/`.
pub(super) fn run(root: &Path, args: &MappingArgs) -> Result<(), StepFailed> {
    let bench = args.common.bench(root, RECORDINGS)?;
    let arms: Vec<_> = ARMS.into_iter().filter(|(name, _)| args.arms.is_wanted(name)).collect();
    let runs: Vec<(&str, &str, &[&str])> = bench
        .recordings
        .iter()
        .flat_map(|name| arms.iter().map(move |(arm, settings)| (name.as_str(), *arm, *settings)))
        .collect();
    let found = run_all(usize::from(args.arms.jobs), &runs, |(name, arm, settings)| {
        figures_of(&bench, args, (name, arm), settings)
    });
    let mut text = heading();
    let mut notes = Vec::new();
    for ((name, arm, _), figures) in runs.iter().zip(found) {
        let cells = figures.map(|figures| figures.cells()).unwrap_or_else(|problem| {
            notes.push(format!("{name}, {arm}: {problem}"));
            vec!["-".to_owned(); figures::HEADINGS.len()]
        });
        let _ = writeln!(text, "| {name} | {arm} | {} |", cells.join(" | "));
    }
    notes.extend(args.arms.warning());
    notes.iter().for_each(|note| text.push_str(&format!("\n* {note}")));
    println!("{text}");
    Ok(())
}

/// Maps a recording, and refines the map.
fn figures_of(
    bench: &Bench,
    args: &MappingArgs,
    (name, arm): (&str, &str),
    settings: &[&str],
) -> Result<Figures, StepFailed> {
    let folder: String = arm.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '-' }).collect();
    let out = bench.out.join("mapping").join(name).join(folder);
    let settings: Vec<String> = settings.iter().map(|setting| format!("--set={setting}")).collect();
    let mut options = vec!["--camera=kitti".to_owned(), format!("--iterations={}", args.iterations)];
    options.extend(args.common.frames.map(|n| format!("--frames={n}")));
    options.extend(settings.clone());
    bench.replay_and_judge(&bench.data.join(name), &out, &options)?;
    let report = read_json(&out.join("report.json"))?;
    let n_keyframes = report["frames"]["keyframes"].as_u64().unwrap_or_default();
    if args.refine == 0 {
        return Ok(Figures::new(report, ""));
    }
    let steps = u64::from(args.refine) * n_keyframes;
    let mut words = vec!["refine".to_owned(), out.join("map").to_string_lossy().into_owned()];
    words.push(format!("--iterations={steps}"));
    words.extend(settings);
    let refined = out.join("refined");
    bench.kilogs(&refined, &words)?;
    let path = refined.join("said.txt");
    let said = std::fs::read_to_string(&path)
        .map_err(|error| StepFailed::Broken(format!("reading {}: {error}", path.display())))?;
    Ok(Figures::new(report, &said))
}

fn heading() -> String {
    format!(
        "| recording | arm | {} |\n|---|---|{}\n",
        figures::HEADINGS.join(" | "),
        "---:|".repeat(figures::HEADINGS.len())
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_as_many_cells_as_headings() {
        let bars: Vec<usize> = heading().lines().map(|line| line.matches('|').count()).collect();
        assert_eq!(bars, [figures::HEADINGS.len() + 3; 2]);
        assert_eq!(Figures::new(serde_json::Value::Null, "").cells().len(), figures::HEADINGS.len());
    }
}
