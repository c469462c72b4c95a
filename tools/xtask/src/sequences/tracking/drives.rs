//! Simulated drives that break trackers: a street that is spoilt, and other motions and streets.

use super::{Run, TrackingArgs};
use crate::sequences::Bench;
use crate::step::StepFailed;
use std::ops::Range;
use std::path::{Path, PathBuf};

/// What befalls the street: effect and frames. Frozen and missing frames last a second.
const EFFECTS: [(&str, Range<u64>); 10] = [
    ("tunnel", 60..90),
    ("glare", 60..90),
    ("frozen", 60..70),
    ("gap", 60..70),
    ("blur", 60..90),
    ("zoom-blur", 60..90),
    ("noise", 60..90),
    ("rain", 60..90),
    ("truck", 60..100),
    ("dirt", 60..120),
];

/// Drives of the simulator that are hard by themselves.
const KINDS: [&str; 4] = ["pure-rotation", "standing-then-go", "planar-road", "planar-wall"];

/// Length, m, and seed of every drive.
const DRIVE: [&str; 2] = ["--length=130", "--seed=5"];
/// Frames behind the spoilt ones in which the tracker has to find its way back.
const RECOVERY_FRAMES: u64 = 10;
/// Share of a planar drive that has more than a plane to see.
const BEFORE_PLANE: f64 = 1.0 / 3.0;

const FALLBACK: [(&str, &[&str]); 2] = [("on", &[]), ("off", &["tracking.dense_fallback=off"])];

/// Every wanted drive with and without the dense fallback. The drives are written below the output folder.
pub(super) fn runs(bench: &Bench, args: &TrackingArgs) -> Result<Vec<(PathBuf, Run)>, StepFailed> {
    let mut runs = Vec::new();
    let effects: Vec<_> = EFFECTS.into_iter().filter(|(effect, _)| args.common.is_wanted(effect)).collect();
    if !effects.is_empty()
        && let Some(street) = simulated(bench, "street")
    {
        for (effect, spoilt) in effects {
            let option = format!("--degrade={effect}@{}..{}", spoilt.start, spoilt.end);
            runs.extend(arms(args, &street, effect, spoilt, Some(option)));
        }
    }
    for kind in KINDS.into_iter().filter(|kind| args.common.is_wanted(kind)) {
        if let Some(drive) = simulated(bench, kind) {
            let spoilt = hard_frames(kind, &drive.join("poses.txt"))?;
            runs.extend(arms(args, &drive, kind, spoilt, None));
        }
    }
    Ok(runs)
}

fn arms<'a>(
    args: &'a TrackingArgs,
    drive: &'a Path,
    name: &'a str,
    spoilt: Range<u64>,
    option: Option<String>,
) -> impl Iterator<Item = (PathBuf, Run)> + 'a {
    FALLBACK.into_iter().map(move |(fallback, settings)| {
        let mut options = args.options(settings);
        options.extend(option.clone());
        let run = Run {
            names: [name.to_owned(), fallback.to_owned()],
            folder: format!("drives/{name}/fallback-{fallback}"),
            options,
            spoilt: Some(spoilt.start..spoilt.end + RECOVERY_FRAMES),
        };
        (drive.to_owned(), run)
    })
}

/// Simulates a drive; one that the program does not know is left out.
fn simulated(bench: &Bench, kind: &str) -> Option<PathBuf> {
    let drive = bench.out.join("drives").join(kind);
    let mut words: Vec<String> =
        ["camera", "sim", "--mono", "--quiet"].into_iter().chain(DRIVE).map(str::to_owned).collect();
    words.push(format!("--write={}", drive.display()));
    if kind != "street" {
        words.push(format!("--drive={kind}"));
    }
    let _ = std::fs::remove_dir_all(&drive);
    match bench.kilogs(&drive, &words) {
        Ok(()) => Some(drive),
        Err(problem) => {
            eprintln!("left out: {kind}: {problem}");
            None
        }
    }
}

/// Frames in which a drive stands or has one plane to see, from the first to the last.
fn hard_frames(kind: &str, poses: &Path) -> Result<Range<u64>, StepFailed> {
    let broken = |reason: String| StepFailed::Broken(format!("reading {}: {reason}", poses.display()));
    let text = std::fs::read_to_string(poses).map_err(|e| broken(e.to_string()))?;
    let position = |line: &str| -> Option<[f64; 2]> {
        let words: Vec<&str> = line.split_whitespace().collect();
        Some([words.get(3)?.parse().ok()?, words.get(11)?.parse().ok()?])
    };
    let positions: Option<Vec<[f64; 2]>> = text.lines().map(position).collect();
    let positions = positions.ok_or_else(|| broken("a line is no pose".to_owned()))?;
    let end_z = positions.last().map_or(0.0, |last| last[1]);
    let is_hard = |i: usize| match kind.starts_with("planar") {
        true => positions[i][1] > BEFORE_PLANE * end_z,
        false => i > 0 && positions[i] == positions[i - 1],
    };
    let hard: Vec<u64> = (0..positions.len()).filter(|&i| is_hard(i)).map(|i| i as u64).collect();
    match (hard.first(), hard.last()) {
        (Some(first), Some(last)) => Ok(*first..last + 1),
        _ => Err(broken(format!("the drive {kind} has no hard frames"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hard_frames_are_those_that_stand_or_see_a_plane() {
        let check = |kind: &str, ways_m: &[f64], expected: Option<Range<u64>>| {
            let file = tempfile::NamedTempFile::new().expect("a temporary file");
            let lines: String = ways_m.iter().map(|z| format!("1 0 0 0 0 1 0 0 0 0 1 {z}\n")).collect();
            std::fs::write(file.path(), lines).expect("a temporary file");
            assert_eq!(hard_frames(kind, file.path()).ok(), expected, "{kind} {ways_m:?}");
        };
        check("pure-rotation", &[0.0, 1.0, 2.0, 2.0, 2.0, 3.0], Some(3..5));
        check("planar-road", &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0], Some(3..7));
        check("pure-rotation", &[0.0, 1.0], None);
    }
}
