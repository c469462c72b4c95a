//! `cargo xtask sequences mapping`: what each part of the mapper is worth, as mapped and refined, and what a map forgets.

mod arms;
mod figures;
mod forgetting;

use super::bench::read_text;
use super::{ArmArgs, Bench, CommonArgs, read_json, run_all};
use crate::step::StepFailed;
use arms::{ARMS, Arm, folder_name};
use figures::Figures;
use forgetting::Views;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Recordings in the order of the table.
const RECORDINGS: [&str; 3] = ["kitti00-0000-1699", "kitti04-full", "kitti00-lowres-colour-0000-1017"];

/// Options of `cargo xtask sequences mapping`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  cargo xtask sequences mapping --frames 100 --iterations 4 --refine 4\n  \
                  cargo xtask sequences mapping --only kitti04 --frames 80 --arms ours,insertion --jobs 2\n  \
                  cargo xtask sequences mapping --frames 150 --arms lifecycle --kilogs target/release/kilogs\n  \
                  cargo xtask sequences mapping --only 1699 --frames 400 --arms ours,decoder --iterations 4 --refine 0")]
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
    /// Training steps per keyframe while refining; 0 leaves it out, and the arms that differ in nothing else.
    #[arg(long, default_value_t = 10, value_name = "N")]
    refine: u32,
}

/// A recording that is mapped with the settings of an arm, for every arm that has the same.
#[derive(Clone, Copy)]
struct Drive<'a> {
    recording: &'a str,
    arm: &'a Arm,
}

/// What all runs share.
struct Runs<'a> {
    bench: &'a Bench,
    args: &'a MappingArgs,
}

/// Prints the tables on stdout. Output folders go below `target/`.
pub(super) fn run(root: &Path, args: &MappingArgs) -> Result<(), StepFailed> {
    let bench = args.common.bench(root, RECORDINGS)?;
    let runs = Runs { bench: &bench, args };
    let jobs = usize::from(args.arms.jobs);
    let is_wanted = |arm: &&Arm| args.arms.is_wanted(arm.name) && (args.refine > 0 || arm.refining.is_empty());
    let arms: Vec<&Arm> = ARMS.iter().filter(is_wanted).collect();
    let rows: Vec<Drive<'_>> =
        bench.recordings.iter().flat_map(|recording| arms.iter().map(|arm| Drive { recording, arm })).collect();
    let mut drives: Vec<Drive<'_>> = Vec::new();
    for row in &rows {
        if !drives.iter().any(|drive| drive.is_of(row)) {
            drives.push(*row);
        }
    }
    let driven = run_all(jobs, &drives, |drive| runs.drive(drive));
    let refined = run_all(jobs, &rows, |row| {
        let drive = drives.iter().find(|drive| drive.is_of(row)).unwrap_or(row);
        runs.figures(drive, row)
    });
    let mut notes: Vec<String> =
        drives.iter().zip(driven).filter_map(|(drive, done)| Some(drive.note(&done.err()?))).collect();
    let mut text = heading();
    for (row, figures) in rows.iter().zip(refined) {
        let cells = figures.map(|figures| figures.cells()).unwrap_or_else(|problem| {
            notes.push(row.note(&problem));
            vec!["-".to_owned(); figures::HEADINGS.len()]
        });
        let _ = writeln!(text, "| {} | {} | {} |", row.recording, row.arm.name, cells.join(" | "));
    }
    let remembering: Vec<Drive<'_>> = rows.into_iter().filter(|row| row.arm.shows_forgetting()).collect();
    let forgotten = run_all(jobs, &remembering, |drive| runs.forgetting(drive));
    text.push_str(&forgetting_table(&remembering, forgotten, &mut notes));
    notes.extend(args.arms.warning());
    notes.iter().for_each(|note| text.push_str(&format!("\n* {note}")));
    println!("{text}");
    Ok(())
}

impl Drive<'_> {
    fn is_of(&self, other: &Self) -> bool {
        self.recording == other.recording && self.arm.mapping == other.arm.mapping
    }

    fn note(&self, problem: &StepFailed) -> String {
        format!("{}, {}: {problem}", self.recording, self.arm.name)
    }
}

impl Runs<'_> {
    /// Folder of a drive, or of something else that was made for an arm.
    fn folder(&self, drive: &Drive<'_>, purpose: &str) -> PathBuf {
        self.bench.out.join("mapping").join(drive.recording).join(folder_name(drive.arm.name)).join(purpose)
    }

    fn drive(&self, drive: &Drive<'_>) -> Result<(), StepFailed> {
        self.drive_frames(drive, self.args.common.frames.map(u64::from), &self.folder(drive, "drive"))
    }

    fn drive_frames(&self, drive: &Drive<'_>, frames: Option<u64>, out: &Path) -> Result<(), StepFailed> {
        let mut options = vec!["--camera=kitti".to_owned(), format!("--iterations={}", self.args.iterations)];
        options.extend(frames.map(|n| format!("--frames={n}")));
        options.extend(drive.arm.mapping.iter().map(|setting| format!("--set={setting}")));
        self.bench.replay_and_judge(&self.bench.data.join(drive.recording), out, &options)
    }

    /// Refines a copy of the map of `drive` with the settings of `row`.
    fn figures(&self, drive: &Drive<'_>, row: &Drive<'_>) -> Result<Figures, StepFailed> {
        let driven = self.folder(drive, "drive");
        let report = read_json(&driven.join("report.json"))?;
        // A recording without truth is not judged.
        let judged = read_json(&driven.join("eval.json")).unwrap_or_default();
        let n_keyframes = report["frames"]["keyframes"].as_u64().unwrap_or_default();
        if self.args.refine == 0 {
            return Ok(Figures::new(report, judged, ""));
        }
        let refined = self.folder(row, "refined");
        let _ = std::fs::remove_dir_all(&refined);
        let map = refined.join("map");
        copy_folder(&driven.join("map"), &map)?;
        let mut words = vec!["refine".to_owned(), map.to_string_lossy().into_owned()];
        words.push(format!("--iterations={}", u64::from(self.args.refine) * n_keyframes));
        words.push(format!("--views={}", refined.join("views.csv").display()));
        words.extend(row.arm.mapping.iter().chain(row.arm.refining).map(|setting| format!("--set={setting}")));
        self.bench.kilogs(&refined, &words)?;
        Ok(Figures::new(report, judged, &read_text(&refined.join("said.txt"))?))
    }

    /// What the first chunk of a drive scored when it was finished, and after the drive; `None` when it never was.
    fn forgetting(&self, drive: &Drive<'_>) -> Result<Option<[String; 2]>, StepFailed> {
        let whole = Views::read(&self.folder(drive, "drive"))?;
        let Some(n_frames) = whole.frames_until_finished() else { return Ok(None) };
        let begun = self.folder(drive, "first-chunk");
        self.drive_frames(drive, Some(n_frames), &begun)?;
        Ok(Some([Views::read(&begun)?.first_chunk(), whole.first_chunk()]))
    }
}

fn heading() -> String {
    format!(
        "| recording | arm | {} |\n|---|---|{}\n",
        figures::HEADINGS.join(" | "),
        "---:|".repeat(figures::HEADINGS.len())
    )
}

/// Rows of the drives that finished a chunk; nothing when none did.
fn forgetting_table(
    drives: &[Drive<'_>],
    found: Vec<Result<Option<[String; 2]>, StepFailed>>,
    notes: &mut Vec<String>,
) -> String {
    let mut rows = String::new();
    for (drive, found) in drives.iter().zip(found) {
        match found {
            Ok(Some([finished, after])) => {
                let _ = writeln!(rows, "| {} | {} | {finished} | {after} |", drive.recording, drive.arm.name);
            }
            Ok(None) => notes.push(format!("{}: no chunk was finished; give more frames", drive.recording)),
            Err(problem) => notes.push(drive.note(&problem)),
        }
    }
    notes.dedup();
    if rows.is_empty() {
        return rows;
    }
    format!("\n| recording | arm | first chunk when finished, dB | after the drive |\n|---|---|---:|---:|\n{rows}")
}

/// Copies a folder of files and folders.
fn copy_folder(from: &Path, to: &Path) -> Result<(), StepFailed> {
    copy_entries(from, to)
        .map_err(|error| StepFailed::Broken(format!("copying {} to {}: {error}", from.display(), to.display())))
}

fn copy_entries(from: &Path, to: &Path) -> std::io::Result<()> {
    std::fs::create_dir_all(to)?;
    for entry in std::fs::read_dir(from)? {
        let entry = entry?;
        let target = to.join(entry.file_name());
        if entry.file_type()?.is_dir() {
            copy_entries(&entry.path(), &target)?;
        } else {
            std::fs::copy(entry.path(), target)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const DRIVE: Drive<'_> = Drive { recording: "street", arm: &ARMS[0] };

    #[test]
    fn a_table_has_as_many_cells_as_headings() {
        let bars: Vec<usize> = heading().lines().map(|line| line.matches('|').count()).collect();
        assert_eq!(bars, [figures::HEADINGS.len() + 3; 2]);
        assert_eq!(
            Figures::new(serde_json::Value::Null, serde_json::Value::Null, "").cells().len(),
            figures::HEADINGS.len()
        );
    }

    #[test]
    fn arms_that_differ_in_refining_share_a_drive_and_no_folder() {
        let drives = ARMS.each_ref().map(|arm| Drive { recording: "street", arm });
        assert!(drives.iter().filter(|drive| drive.is_of(&DRIVE)).all(|drive| drive.arm.mapping.is_empty()));
        assert_eq!(drives.iter().filter(|drive| drive.is_of(&DRIVE)).count(), 9);
        let folders: std::collections::BTreeSet<String> = ARMS.iter().map(|arm| folder_name(arm.name)).collect();
        assert_eq!(folders.len(), ARMS.len());
        assert_eq!(ARMS.iter().filter(|arm| arm.shows_forgetting()).count(), 3);
    }

    #[test]
    fn short_drives_forget_nothing_and_say_so_once() {
        let mut notes = Vec::new();
        let table = forgetting_table(&[DRIVE, DRIVE], vec![Ok(None), Ok(None)], &mut notes);
        assert_eq!((table.as_str(), notes.len()), ("", 1));
        let found = Ok(Some(["20.00 / 18.00", "20.10 / -"].map(str::to_owned)));
        let table = forgetting_table(&[DRIVE], vec![found], &mut notes);
        assert!(table.ends_with("| street | ours | 20.00 / 18.00 | 20.10 / - |\n"), "{table}");
    }

    #[test]
    fn a_folder_is_copied_whole() {
        let dir = tempfile::tempdir().expect("a folder");
        let (from, to) = (dir.path().join("from"), dir.path().join("to"));
        std::fs::create_dir_all(from.join("pages")).expect("a folder");
        std::fs::write(from.join("pages/1.kgs"), "one").expect("a file");
        copy_folder(&from, &to).expect("copied");
        assert_eq!(std::fs::read_to_string(to.join("pages/1.kgs")).expect("a file"), "one");
        assert!(copy_folder(&dir.path().join("none"), &to).is_err());
    }
}
