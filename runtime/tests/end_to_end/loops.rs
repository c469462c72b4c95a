//! A drive around a block: where it comes back to, the loop is closed.

use crate::drive::Drive;
use crate::program::{kilogs_succeeds, word};
use crate::replay::{check_same, count, json, number};
use std::collections::BTreeMap;
use std::path::Path;

/// A place that is recognized was seen from at most so far away, m.
const SAME_PLACE_M: f64 = 4.0;

/// How far the trajectory of a replay is from the truth, m.
fn replay(drive: &Drive, out: &Path, closes_loops: bool, options: &[&str]) -> f64 {
    let (dataset, folder) = (word(drive.path()), word(out));
    let closes_loops = format!("loop_closure.enabled={closes_loops}");
    let words = ["replay", &dataset, "--out", &folder, "--set", closes_loops.as_str()];
    kilogs_succeeds(words.iter().chain(options));
    kilogs_succeeds(["eval", &folder, "--gt", &word(&drive.file("poses.txt"))]);
    number(&json(&out.join("eval.json")), "/ate_sim3_m")
}

/// Frame that saw, and frame whose place was seen, of every loop that was closed.
fn loops(out: &Path) -> Vec<(usize, usize)> {
    let csv = std::fs::read_to_string(out.join("loops.csv")).expect("the table");
    let rows = || csv.lines().skip(1).map(|line| line.split(',').collect::<Vec<_>>());
    let number = |cell: &str| cell.parse::<usize>().expect("a number");
    let frames: BTreeMap<&str, usize> = rows().map(|row| (row[1], number(row[0]))).collect();
    rows().filter(|row| row[3] == "accepted").map(|row| (number(row[0]), frames[row[2]])).collect()
}

/// Every loop connects one place with itself.
fn check_places(drive: &Drive, found: &[(usize, usize)]) {
    let places_m = true_places_m(drive);
    for &(frame, old_frame) in found {
        let (now, then) = (places_m[frame], places_m[old_frame]);
        let away_m = (now[0] - then[0]).hypot(now[1] - then[1]);
        assert!(away_m < SAME_PLACE_M, "frame {frame} is {away_m} m away from frame {old_frame}");
    }
}

/// Position of every frame.
fn true_places_m(drive: &Drive) -> Vec<[f64; 2]> {
    let text = std::fs::read_to_string(drive.file("poses.txt")).expect("the truth");
    let number =
        |line: &str, nth: usize| line.split_whitespace().nth(nth).and_then(|n| n.parse().ok()).expect("a number");
    text.lines().map(|line| [number(line, 3), number(line, 11)]).collect()
}

#[test]
fn a_block_is_closed_where_it_is_and_map_and_trajectory_follow_with_the_same_bytes_every_time() {
    let drive = Drive::around_a_block(40.0, 200.0, 0.9);
    let out = tempfile::tempdir().expect("a folder");
    let [with, again, without] = ["with", "again", "without"].map(|name| out.path().join(name));
    let ate_m = replay(&drive, &with, true, &["--iterations", "2"]);
    replay(&drive, &again, true, &["--iterations", "2"]);
    check_same(&with, &again);
    let ate_without_m = replay(&drive, &without, false, &["--iterations", "2"]);

    let found = loops(&with);
    assert_eq!(found.len() as u64, count(&json(&with.join("report.json")), "/tracking/loops"));
    assert!(found.len() >= 3, "{found:?}");
    check_places(&drive, &found);
    assert!(with.join("map/alignment.kgs").is_file() && !without.join("map/alignment.kgs").exists());
    assert!(!without.join("loops.csv").exists(), "nobody looked for loops");

    let psnr_db = |out: &Path| number(&json(&out.join("report.json")), "/mapping/psnr_train_db");
    let (db, without_db) = (psnr_db(&with), psnr_db(&without));
    println!("a block: ATE {ate_without_m:.3} m became {ate_m:.3} m, PSNR {without_db:.2} dB became {db:.2} dB");
    assert!(ate_m < 0.6 * ate_without_m, "{ate_without_m} m became {ate_m} m");
    assert!(db > without_db - 0.1, "{without_db} dB became {db} dB");
}

/// Five seconds are missing, with a corner in them: no image says where the drive went.
#[test]
fn a_drive_whose_camera_fails_for_five_seconds_is_found_again_in_the_street_that_it_comes_back_to() {
    const BACK: usize = 150;
    let drive = Drive::around_a_block(40.0, 200.0, 0.9);
    let out = tempfile::tempdir().expect("a folder");
    let [with, without] = ["with", "without"].map(|name| out.path().join(name));
    let cut = ["--set", "mapping.enabled=false", "--degrade", "gap@100..150"];
    let (ate_m, ate_without_m) = (replay(&drive, &with, true, &cut), replay(&drive, &without, false, &cut));
    let found = loops(&with);
    check_places(&drive, &found);
    let first = found.iter().map(|(frame, _)| *frame).find(|&frame| frame >= BACK).expect("it is found");
    println!("five seconds cut: found {} frames later, ATE {ate_without_m:.2} m became {ate_m:.2} m", first - BACK);
    assert!(ate_without_m > 3.0 && ate_m < 0.25 * ate_without_m, "{ate_without_m} m became {ate_m} m");
    let csv = std::fs::read_to_string(with.join("frames.csv")).expect("the table");
    let told = csv.lines().skip(1 + BACK).take(10).any(|row| row.contains(",doubtful,restarted,"));
    assert!(told, "the frame at which tracking began anew says so");
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
