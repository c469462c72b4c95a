//! A drive around a block: where it comes back to, the loop is closed.

use crate::drive::Drive;
use crate::program::{kilogs_succeeds, word};
use crate::replay::{check_same, count, json, number};
use std::path::Path;

/// A place that is recognized was seen from at most so far away, m.
const SAME_PLACE_M: f64 = 4.0;

/// What a replay logged, and how far its trajectory is from the truth, m.
fn replay(drive: &Drive, out: &Path, closes_loops: bool) -> (String, f64) {
    let (dataset, folder) = (word(drive.path()), word(out));
    let closes_loops = format!("loop_closure.enabled={closes_loops}");
    let ended =
        kilogs_succeeds(["replay", &dataset, "--out", &folder, "--iterations", "2", "--set", closes_loops.as_str()]);
    kilogs_succeeds(["eval", &folder, "--gt", &word(&drive.file("poses.txt"))]);
    (ended.stderr, number(&json(&out.join("eval.json")), "/ate_sim3_m"))
}

/// Frame that saw, and keyframe whose place was seen, of every loop that a log tells of.
fn loops(log: &str) -> Vec<(usize, usize)> {
    let number_behind = |line: &str, words: &str| {
        let rest = line.split(words).nth(1)?;
        rest.split(|c: char| !c.is_ascii_digit()).next()?.parse().ok()
    };
    let of_line = |line: &str| Some((number_behind(line, "(frame ")?, number_behind(line, "the place of keyframe ")?));
    log.lines().filter(|line| line.contains("loop: keyframe")).filter_map(of_line).collect()
}

/// Position of every frame.
fn true_places_m(drive: &Drive) -> Vec<[f64; 2]> {
    let text = std::fs::read_to_string(drive.file("poses.txt")).expect("the truth");
    let number =
        |line: &str, nth: usize| line.split_whitespace().nth(nth).and_then(|n| n.parse().ok()).expect("a number");
    text.lines().map(|line| [number(line, 3), number(line, 11)]).collect()
}

/// Frame of every keyframe.
fn frames_of_keyframes(out: &Path) -> Vec<usize> {
    let csv = std::fs::read_to_string(out.join("frames.csv")).expect("the table");
    let rows = csv.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
    rows.filter(|row| row[4] == "1").map(|row| row[0].parse().expect("an index")).collect()
}

#[test]
fn a_block_is_closed_where_it_is_and_map_and_trajectory_follow_with_the_same_bytes_every_time() {
    let drive = Drive::around_a_block(40.0, 200.0, 0.9);
    let out = tempfile::tempdir().expect("a folder");
    let [with, again, without] = ["with", "again", "without"].map(|name| out.path().join(name));
    let (log, ate_m) = replay(&drive, &with, true);
    replay(&drive, &again, true);
    check_same(&with, &again);
    let (log_without, ate_without_m) = replay(&drive, &without, false);

    let (found, places_m, frames) = (loops(&log), true_places_m(&drive), frames_of_keyframes(&with));
    assert_eq!(found.len() as u64, count(&json(&with.join("report.json")), "/tracking/loops"), "{log}");
    assert!(found.len() >= 3 && loops(&log_without).is_empty(), "{log}");
    for (frame, keyframe) in found {
        let (now, then) = (places_m[frame], places_m[frames[keyframe]]);
        let away_m = (now[0] - then[0]).hypot(now[1] - then[1]);
        assert!(away_m < SAME_PLACE_M, "frame {frame} is {away_m} m away from frame {}", frames[keyframe]);
    }
    assert!(with.join("map/alignment.kgs").is_file() && !without.join("map/alignment.kgs").exists());

    let psnr_db = |out: &Path| number(&json(&out.join("report.json")), "/mapping/psnr_train_db");
    let (db, without_db) = (psnr_db(&with), psnr_db(&without));
    println!("a block: ATE {ate_without_m:.3} m became {ate_m:.3} m, PSNR {without_db:.2} dB became {db:.2} dB");
    assert!(ate_m < 0.6 * ate_without_m, "{ate_without_m} m became {ate_m} m");
    assert!(db > without_db - 0.1, "{without_db} dB became {db} dB");
}

/// Positions of all frames in a trajectory file, m.
fn trajectory_m(out: &Path) -> Vec<[f64; 3]> {
    let text = std::fs::read_to_string(out.join("trajectory_tum.txt")).expect("a trajectory");
    let line = |line: &str| {
        let numbers: Vec<f64> = line.split_whitespace().map(|n| n.parse().expect("a number")).collect();
        [numbers[1], numbers[2], numbers[3]]
    };
    text.lines().map(line).collect()
}

#[test]
fn a_drive_that_begins_somewhere_in_a_stored_street_is_found_there() {
    const START: usize = 20;
    let drive = Drive::new(60.0);
    let out = tempfile::tempdir().expect("a folder");
    let [first, second] = ["first", "second"].map(|name| out.path().join(name));
    let (dataset, map) = (word(drive.path()), word(&first.join("map")));
    kilogs_succeeds(["replay", &dataset, "--out", &word(&first), "--iterations", "1"]);
    let (start, second_out) = (START.to_string(), word(&second));
    let resumed = ["--start", &start, "--frames", "30", "--resume", &map, "--out", &second_out, "--iterations", "1"];
    let ended = kilogs_succeeds(["replay", dataset.as_str()].iter().chain(&resumed));
    assert!(ended.stderr.contains("recognized: "), "{}", ended.stderr);
    let (known_m, found_m) = (trajectory_m(&first), trajectory_m(&second));
    let off_m = found_m
        .iter()
        .zip(&known_m[START..])
        .map(|(found, known)| found.iter().zip(known).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt());
    let worst_m = off_m.fold(0.0, f64::max);
    println!("resumed somewhere in a street: {} frames within {worst_m:.3} m of where the map has them", found_m.len());
    assert!(found_m.len() == 30 && worst_m < 0.7, "{worst_m} m off");
}
