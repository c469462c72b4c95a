//! `cargo xtask sequences loops`: what closing loops is worth, in a town as long as KITTI 00, on recordings, and after a cut.

mod figures;
mod judge;

use super::{ArmArgs, Bench, CommonArgs, run_all};
use crate::step::StepFailed;
use figures::{Cut, Drive};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Recordings with a truth, in the order of the table.
const RECORDINGS: [&str; 6] = [
    "kitti00-0000-1699",
    "kitti00-lowres-colour-0000-1017",
    "kitti04-full",
    "kitti01-0000-0050",
    "kitti05-0100-0159-stereo",
    "kitti06-0000-0050",
];

/// The simulated town, and the way through it: poses below the folder of the recordings.
const TOWN: &str = "town";
const TOWN_PATH: &str = "kitti-gt-poses/poses/00.txt";
const TOWN_SIZE: [u32; 2] = [416, 128];

/// Five seconds without a frame: where, the first that is missing, and the first that comes again. The first of each ends just
/// before a known street, the second far from one.
const CUTS: [(&str, u64, u64); 4] =
    [("kitti00-0000-1699", 1510, 1560), ("kitti00-0000-1699", 900, 950), (TOWN, 1500, 1550), (TOWN, 900, 950)];

/// Options of `cargo xtask sequences loops`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  cargo xtask sequences loops --only kitti\n  \
                  cargo xtask sequences loops --only town --frames 1700 --kilogs target/release/kilogs\n  \
                  cargo xtask sequences loops --only town --map=1 --arms drive")]
pub(super) struct LoopsArgs {
    /// What all tables share.
    #[command(flatten)]
    common: CommonArgs,
    /// Which tables (`drive`, `cut`), and how many runs at once.
    #[command(flatten)]
    arms: ArmArgs,
    /// Map too, with this many training steps per keyframe, for the map's PSNR in streets that are driven again.
    #[arg(long, value_name = "STEPS", require_equals = true)]
    map: Option<u32>,
}

/// One run of the program.
struct Run {
    dataset: PathBuf,
    out: PathBuf,
    options: Vec<String>,
}

/// A line of a table: its first cells, and the runs without and with closing loops.
struct Row {
    name: String,
    runs: [Run; 2],
    /// First frame behind a cut.
    until: usize,
}

/// Prints the tables on stdout. Output folders go below `target/`.
pub(super) fn run(root: &Path, args: &LoopsArgs) -> Result<(), StepFailed> {
    let bench = args.common.bench(root, RECORDINGS)?;
    let town = if args.common.is_wanted(TOWN) { simulated_town(&bench, args) } else { None };
    let recordings = bench.recordings.iter().map(|name| (name.clone(), bench.data.join(name)));
    let drives: Vec<(String, PathBuf)> =
        town.map(|town| (TOWN.to_owned(), town)).into_iter().chain(recordings).collect();
    if args.arms.is_wanted("drive") {
        let rows = drives.iter().map(|drive| args.row(&bench, drive, None)).collect();
        println!(
            "{}",
            table(&bench, args, "drive", &Drive::HEADINGS, rows, |row, truth| {
                Ok(Drive::read(row.outs(), truth)?.cells())
            })
        );
    }
    let of_cut = |(name, from, until)| {
        let is_long_enough = args.common.frames.is_none_or(|frames| u64::from(frames) > until);
        let drive = drives.iter().find(|(drive, _)| drive == name).filter(|_| is_long_enough)?;
        Some(args.row(&bench, drive, Some((from, until))))
    };
    let cuts: Vec<Row> = CUTS.into_iter().filter_map(of_cut).collect();
    if args.arms.is_wanted("cut") && !cuts.is_empty() {
        println!(
            "{}",
            table(&bench, args, "drive | frames missing", &Cut::HEADINGS, cuts, |row, truth| {
                Ok(Cut::read(row.outs(), truth, row.until)?.cells())
            })
        );
    }
    Ok(())
}

/// Writes the town's images; left out where the way through it is not there.
fn simulated_town(bench: &Bench, args: &LoopsArgs) -> Option<PathBuf> {
    let (path, out) = (bench.data.join(TOWN_PATH), bench.out.join("drives").join(TOWN));
    let [width, height] = TOWN_SIZE.map(|side| side.to_string());
    let mut words: Vec<String> =
        ["camera", "sim", "--mono", "--quiet", "--width", &width, "--height", &height].map(str::to_owned).into();
    words.extend([format!("--path={}", path.display()), format!("--write={}", out.display())]);
    words.extend(args.common.frames.map(|n| format!("--frames={n}")));
    let _ = std::fs::remove_dir_all(&out);
    match bench.kilogs(&out, &words) {
        Ok(()) => Some(out),
        Err(problem) => {
            eprintln!("left out: {TOWN}: {problem}");
            None
        }
    }
}

/// Makes all runs and lays their figures out; what could not be had is a dash, with its reason below.
fn table(
    bench: &Bench,
    args: &LoopsArgs,
    names: &str,
    headings: &[&str],
    rows: Vec<Row>,
    cells: impl Fn(&Row, &Path) -> Result<Vec<String>, StepFailed>,
) -> String {
    let runs: Vec<&Run> = rows.iter().flat_map(|row| &row.runs).collect();
    let done =
        run_all(usize::from(args.arms.jobs), &runs, |run| bench.replay_and_judge(&run.dataset, &run.out, &run.options));
    let n_columns = headings.len() + names.matches('|').count();
    let mut text = format!("| {names} | {} |\n|---|{}\n", headings.join(" | "), "---:|".repeat(n_columns));
    let mut notes = Vec::new();
    let mut done = done.into_iter();
    for row in &rows {
        let both = done.by_ref().take(row.runs.len()).collect::<Result<Vec<()>, _>>();
        let cells = both.and_then(|_| cells(row, &row.runs[0].dataset.join("poses.txt"))).unwrap_or_else(|problem| {
            notes.push(format!("{}: {problem}", row.name));
            vec!["-".to_owned(); headings.len()]
        });
        let _ = writeln!(text, "| {} | {} |", row.name, cells.join(" | "));
    }
    notes.extend(args.arms.warning());
    notes.iter().for_each(|note| text.push_str(&format!("\n* {note}")));
    text
}

impl Row {
    fn outs(&self) -> [&Path; 2] {
        self.runs.each_ref().map(|run| run.out.as_path())
    }
}

impl LoopsArgs {
    fn row(&self, bench: &Bench, (name, dataset): &(String, PathBuf), cut: Option<(u64, u64)>) -> Row {
        let runs = [false, true].map(|closes| self.run(bench, (name, dataset), closes, cut));
        match cut {
            Some((from, until)) => {
                Row { name: format!("{name} | {from} to {}", until - 1), runs, until: until as usize }
            }
            None => Row { name: name.clone(), runs, until: 0 },
        }
    }

    fn run(&self, bench: &Bench, (name, dataset): (&str, &Path), closes: bool, cut: Option<(u64, u64)>) -> Run {
        let mut options = vec![format!("--set=loop_closure.enabled={closes}")];
        // The simulator writes a camera.toml beside its images.
        options.extend((name != TOWN).then(|| "--camera=kitti".to_owned()));
        options.extend(self.common.frames.map(|n| format!("--frames={n}")));
        options.push(match self.map {
            Some(steps) => format!("--iterations={steps}"),
            None => "--set=mapping.enabled=false".to_owned(),
        });
        options.extend(cut.map(|(from, until)| format!("--degrade=gap@{from}..{until}")));
        let arm = if closes { "with" } else { "without" };
        let folder = cut.map_or_else(|| arm.to_owned(), |(from, _)| format!("cut-{from}-{arm}"));
        Run { dataset: dataset.to_owned(), out: bench.out.join("loops").join(name).join(folder), options }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(map: Option<u32>) -> LoopsArgs {
        let common = CommonArgs { only: None, frames: Some(7), data: None, kilogs: None };
        LoopsArgs { common, arms: ArmArgs { arms: Vec::new(), jobs: 1 }, map }
    }

    #[test]
    fn a_table_has_as_many_cells_as_headings_and_says_what_failed() {
        let bench = Bench::of("data", "out", "no program of this name");
        let drive = (TOWN.to_owned(), PathBuf::from("no folder"));
        for (names, headings, cut) in
            [("drive", &Drive::HEADINGS[..], None), ("drive | frames missing", &Cut::HEADINGS, Some((3, 5)))]
        {
            let args = args(None);
            let rows = vec![args.row(&bench, &drive, cut)];
            let text = table(&bench, &args, names, headings, rows, |_, _| Ok(Vec::new()));
            let bars: Vec<usize> = text.lines().take(3).map(|line| line.matches('|').count()).collect();
            assert_eq!(bars, [bars[0]; 3], "{text}");
            assert!(text.contains("* town"), "{text}");
        }
    }

    #[test]
    fn a_run_says_what_is_cut_and_whether_it_maps() {
        let bench = Bench::of("data", "out", "kilogs");
        let options = |map, cut| args(map).run(&bench, (TOWN, Path::new("t")), true, cut).options.join(" ");
        assert_eq!(options(None, None), "--set=loop_closure.enabled=true --frames=7 --set=mapping.enabled=false");
        assert!(options(Some(2), Some((3, 5))).ends_with("--iterations=2 --degrade=gap@3..5"));
    }
}
