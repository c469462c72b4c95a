//! `cargo xtask sequences tracking`: what each part of the tracker is worth, on recordings and on spoilt drives.

mod drives;
mod figures;

use super::{ArmArgs, Bench, CommonArgs, run_all};
use crate::step::StepFailed;
use figures::Figures;
use std::fmt::Write as _;
use std::path::Path;

/// Recordings in the order of the table; the last one has no truth.
const RECORDINGS: [&str; 7] = [
    "kitti04-full",
    "kitti00-0000-1699",
    "kitti00-lowres-colour-0000-1017",
    "kitti01-0000-0050",
    "kitti05-0100-0159-stereo",
    "kitti06-0000-0050",
    "kittiraw-0926-0060-lidar-colour",
];

/// What is switched: name and settings.
const ARMS: [(&str, &[&str]); 9] = [
    ("full", &[]),
    ("only E", &["tracking.pose_models=essential"]),
    ("only PnP", &["tracking.pose_models=pnp"]),
    ("no dynamic filter", &["tracking.dynamic_filter=off"]),
    ("paper's filter", &["tracking.dynamic_filter=paper"]),
    ("no dense fallback", &["tracking.dense_fallback=off"]),
    ("no BA", &["tracking.bundle_adjustment=off"]),
    ("learned matcher", &["tracking.matcher=xfeat"]),
    ("loops closed", &[CLOSE_LOOPS]),
];

/// Loops would hide what the tracker does by itself, so one arm alone closes them.
const CLOSE_LOOPS: &str = "loop_closure.enabled=true";
const LEAVE_LOOPS: &str = "loop_closure.enabled=false";

/// Options of `cargo xtask sequences tracking`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  cargo xtask sequences tracking\n  cargo xtask sequences tracking --only kitti04 --arms full,dense --jobs 2\n  \
                  cargo xtask sequences tracking --only tunnel --kilogs target/release/kilogs\n  cargo xtask sequences tracking --frames 200 --map=4"
)]
pub(super) struct TrackingArgs {
    /// What all tables share.
    #[command(flatten)]
    common: CommonArgs,
    /// Which arms, and how many at once.
    #[command(flatten)]
    arms: ArmArgs,
    /// Map too, with this many training steps per keyframe, for the map's PSNR. With 20 the whole table takes hours.
    #[arg(long, value_name = "STEPS", num_args = 0..=1, default_missing_value = "20", require_equals = true)]
    map: Option<u32>,
}

/// One run of the program.
struct Run {
    /// First and second cell of its row.
    names: [String; 2],
    /// Name of the output folder below the table's.
    folder: String,
    options: Vec<String>,
    /// Frames of which the models are counted apart: those that are spoilt, and those right behind them.
    spoilt: Option<std::ops::Range<u64>>,
}

/// Prints both tables on stdout. Output folders go below `target/`.
pub(super) fn run(root: &Path, args: &TrackingArgs) -> Result<(), StepFailed> {
    let bench = args.common.bench(root, RECORDINGS)?;
    let arms: Vec<_> = ARMS.into_iter().filter(|(name, _)| args.arms.is_wanted(name)).collect();
    let mut runs = Vec::new();
    for name in &bench.recordings {
        for (arm, settings) in &arms {
            let mut options = vec!["--camera=kitti".to_owned()];
            options.extend(args.options(settings));
            let folder = format!("{name}/{}", arm.replace([' ', '\''], "-"));
            runs.push((
                bench.data.join(name),
                Run { names: [name.clone(), (*arm).to_owned()], folder, options, spoilt: None },
            ));
        }
    }
    if !runs.is_empty() {
        println!("{}", table(&bench, args, "recording | arm", runs));
    }
    let runs = drives::runs(&bench, args)?;
    if !runs.is_empty() {
        println!("{}", table(&bench, args, "drive | dense fallback", runs));
    }
    Ok(())
}

impl TrackingArgs {
    /// Options of a run with these settings.
    fn options(&self, settings: &[&str]) -> Vec<String> {
        let frames = self.common.frames.map(|n| format!("--frames={n}"));
        let mapping = self.map.is_none().then_some("mapping.enabled=false");
        let steps = self.map.map(|n| format!("--iterations={n}"));
        let loops = (!settings.contains(&CLOSE_LOOPS)).then_some(LEAVE_LOOPS);
        let settings = settings.iter().copied().chain(loops).chain(mapping).map(|setting| format!("--set={setting}"));
        frames.into_iter().chain(steps).chain(settings).collect()
    }
}

/// Makes all runs and lays their figures out; what could not be had is a dash, with its reason below.
fn table(bench: &Bench, args: &TrackingArgs, names: &str, runs: Vec<(std::path::PathBuf, Run)>) -> String {
    let out = bench.out.join("tracking");
    let found = run_all(usize::from(args.arms.jobs), &runs, |(dataset, run)| {
        let folder = out.join(&run.folder);
        bench.replay_and_judge(dataset, &folder, &run.options).and_then(|()| Figures::read(&folder, run.spoilt.clone()))
    });
    let has_spoilt = runs.iter().any(|(_, run)| run.spoilt.is_some());
    let mut text = heading(names, has_spoilt);
    let mut reasons = Vec::new();
    for ((_, run), figures) in runs.iter().zip(found) {
        let [first, second] = &run.names;
        let cells = match figures {
            Ok(figures) => figures.cells(has_spoilt),
            Err(problem) => {
                reasons.push(format!("{first}, {second}: {problem}"));
                vec!["-".to_owned(); Figures::headings(has_spoilt).len()]
            }
        };
        let _ = writeln!(text, "| {first} | {second} | {} |", cells.join(" | "));
    }
    reasons.extend(args.arms.warning());
    reasons.iter().for_each(|reason| text.push_str(&format!("\n* {reason}")));
    text
}

fn heading(names: &str, has_spoilt: bool) -> String {
    let headings = Figures::headings(has_spoilt);
    format!("| {names} | {} |\n|---|---|{}\n", headings.join(" | "), "---:|".repeat(headings.len()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_has_as_many_cells_as_headings() {
        for has_spoilt in [false, true] {
            let text = heading("recording | arm", has_spoilt);
            let bars: Vec<usize> = text.lines().map(|line| line.matches('|').count()).collect();
            assert_eq!(bars, [bars[0]; 2], "{text}");
            assert_eq!(bars[0], Figures::headings(has_spoilt).len() + 3);
        }
    }

    #[test]
    fn mapping_is_off_unless_it_is_asked_for() {
        let common = CommonArgs { only: None, frames: Some(7), data: None, kilogs: None };
        let args = TrackingArgs { common, arms: ArmArgs { arms: Vec::new(), jobs: 1 }, map: None };
        let loops_closed = ["loop_closure.enabled=true"];
        assert_eq!(
            args.options(&loops_closed),
            ["--frames=7", "--set=loop_closure.enabled=true", "--set=mapping.enabled=false"]
        );
        let settings = ["tracking.matcher=xfeat"];
        assert_eq!(
            args.options(&settings),
            [
                "--frames=7",
                "--set=tracking.matcher=xfeat",
                "--set=loop_closure.enabled=false",
                "--set=mapping.enabled=false"
            ]
        );
        assert_eq!(
            TrackingArgs { map: Some(4), ..args }.options(&settings),
            ["--frames=7", "--iterations=4", "--set=tracking.matcher=xfeat", "--set=loop_closure.enabled=false"]
        );
    }
}
