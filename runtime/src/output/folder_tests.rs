use super::*;
use crate::output::Stage;
use kilogs_core::tracking::{MatchSource, PoseModel, StatusReason};
use nalgebra::{Matrix6, UnitQuaternion, Vector3};
use tempfile::TempDir;

const SPACING_NS: u64 = 100_000_000;

/// A frame `along_m` behind keyframe `keyframe_ordinal`, which is at 10 m times its ordinal on the z axis.
fn frame(frame_index: u64, status: FrameStatus, keyframe_ordinal: u32, along_m: f64) -> FrameReport {
    let keyframe_from_camera = Rigid::translation(0.0, 0.0, along_m);
    FrameReport {
        frame_index,
        timestamp_ns: frame_index * SPACING_NS,
        status,
        reason: if status == FrameStatus::Tracked { StatusReason::Verified } else { StatusReason::TooFewInliers },
        model: PoseModel::Essential,
        source: MatchSource::Tracks,
        is_keyframe: along_m == 0.0 && status == FrameStatus::Tracked,
        keyframe_ordinal,
        keyframe_from_camera,
        world_from_camera: Rigid::translation(0.0, 0.0, 10.0 * f64::from(keyframe_ordinal)) * keyframe_from_camera,
        covariance: Matrix6::identity(),
        n_tracks: 900,
        n_matches: 800,
        n_inliers: 700,
        n_dynamic: 60,
        median_flow_px: 25.5,
        gric: [f32::NAN; 2],
        rotation_anomaly_rad: std::f32::consts::PI / 180.0,
        direction_anomaly_rad: f32::NAN,
        step_m: 1.25,
        scale_ratio: 1.0,
        scale_sigma: 0.02,
        scale_sources: kilogs_core::scale::ScaleSources::NONE,
        n_road: 40,
    }
}

/// Two keyframes with frames between them, one doubtful, one lost, one dropped.
fn drive(dir: &Path) -> OutputFolder {
    let mut folder = OutputFolder::create(dir, &Rigid::identity()).expect("created");
    let mut times = StageTimes::default();
    times.add(Stage::Tracking, 12.5);
    let frames = [
        frame(0, FrameStatus::Tracked, 0, 0.0),
        frame(1, FrameStatus::Tracked, 0, 5.0),
        frame(2, FrameStatus::Lost, 0, 7.0),
    ];
    frames.iter().for_each(|frame| folder.frame(frame, &times).expect("written"));
    folder.dropped(3, None).expect("written");
    let frames = [frame(4, FrameStatus::Tracked, 1, 0.0), frame(5, FrameStatus::Doubtful, 1, 5.0)];
    frames.iter().for_each(|frame| folder.frame(frame, &times).expect("written"));
    folder
}

fn folder() -> TempDir {
    tempfile::tempdir().expect("temporary folder")
}

/// Times and z of a TUM file.
fn tum_t_z(dir: &Path, name: &str) -> Vec<(f64, f64)> {
    let text = std::fs::read_to_string(dir.join(name)).expect(name);
    let row = |line: &str| {
        let numbers: Vec<f64> = line.split(' ').map(|n| n.parse().expect("a number")).collect();
        assert_eq!(numbers.len(), 8, "{line}");
        (numbers[0], numbers[3])
    };
    text.lines().map(row).collect()
}

#[test]
fn a_doubtful_frame_that_carries_others_is_no_keyframe() {
    let dir = folder();
    let mut folder = drive(dir.path());
    let before = folder.counts();
    let restarted = FrameReport { is_keyframe: true, ..frame(6, FrameStatus::Doubtful, 2, 0.0) };
    for report in [restarted, frame(7, FrameStatus::Tracked, 2, 5.0)] {
        folder.frame(&report, &StageTimes::default()).expect("written");
    }
    assert_eq!(folder.counts().keyframes, before.keyframes);
    let summary = folder.finish().expect("written");
    assert_eq!(summary.n_keyframes, before.keyframes);
    assert_eq!(tum_t_z(dir.path(), "keyframes_tum.txt").len() as u64, before.keyframes);
    let last = tum_t_z(dir.path(), "trajectory_tum.txt").pop();
    assert_eq!(last, Some((0.7, 25.0)), "what it carries has its place");
}

#[test]
fn every_frame_with_a_pose_is_in_the_trajectory_and_every_frame_in_the_others() {
    let dir = folder();
    let folder = drive(dir.path());
    let counts = folder.counts();
    assert_eq!(counts, FrameCounts { tracked: 3, keyframes: 2, doubtful: 1, lost: 1, dropped: 1 });
    let summary = folder.finish().expect("finished");
    assert_eq!(summary, TrajectorySummary { n_poses: 4, n_keyframes: 2, path_length_m: 15.0 });

    let expected = [(0.0, 0.0), (0.1, 5.0), (0.4, 10.0), (0.5, 15.0)];
    assert_eq!(tum_t_z(dir.path(), "trajectory_tum.txt"), expected);
    assert_eq!(tum_t_z(dir.path(), "odometry_tum.txt"), expected);
    assert_eq!(tum_t_z(dir.path(), "keyframes_tum.txt"), [(0.0, 0.0), (0.4, 10.0)]);

    let kitti = std::fs::read_to_string(dir.path().join("trajectory_kitti.txt")).expect("kitti");
    let z: Vec<f64> = kitti.lines().map(|l| l.rsplit(' ').next().expect("z").parse().expect("a number")).collect();
    assert_eq!(z, [0.0, 5.0, 5.0, 5.0, 10.0, 15.0], "line k is frame k");
    let leftovers = std::fs::read_dir(dir.path()).expect("folder").count();
    assert_eq!(leftovers, 5, "the logs are gone");
}

#[test]
fn each_row_of_the_table_has_a_cell_for_each_column() {
    let dir = folder();
    drive(dir.path()).finish().expect("finished");
    let csv = std::fs::read_to_string(dir.path().join("frames.csv")).expect("csv");
    let rows: Vec<Vec<&str>> = csv.lines().map(|line| line.split(',').collect()).collect();
    assert_eq!(rows.len(), 7);
    for row in &rows {
        assert_eq!(row.len(), rows[0].len(), "{row:?}");
    }
    let cell = |row: usize, name: &str| rows[row][rows[0].iter().position(|n| *n == name).expect(name)];
    for (row, name, expected) in [
        (1, "index", "0"),
        (1, "keyframe", "1"),
        (2, "keyframe", "0"),
        (2, "t", "0.100000000"),
        (2, "model", "E"),
        (2, "n_inliers", "700"),
        (2, "rotation_anomaly_deg", "1.000"),
        (2, "direction_anomaly_deg", ""),
        (2, "tracking_ms", "12.500"),
        (2, "reason", "verified"),
        (3, "status", "lost"),
        (3, "reason", "too_few_inliers"),
        (4, "reason", "never_arrived"),
        (4, "status", "dropped"),
        (4, "t", ""),
        (4, "tracking_ms", ""),
        (6, "status", "doubtful"),
    ] {
        assert_eq!(cell(row, name), expected, "row {row}, {name}");
    }
}

#[test]
fn a_corrected_keyframe_moves_turns_and_scales_the_frames_that_hang_on_it() {
    let dir = folder();
    let mut folder = drive(dir.path());
    // Keyframe 1 looks along +x of the world after the correction, and its metres are 0.8 of the world's.
    let right_turn = UnitQuaternion::from_scaled_axis(Vector3::y() * std::f64::consts::FRAC_PI_2);
    let world_from_keyframe = Rigid::from_parts(nalgebra::Translation3::new(1.0, 0.0, 9.0), right_turn);
    let aligned = Similarity::from_isometry(world_from_keyframe, 0.8);
    let was_at = Similarity::from_isometry(Rigid::translation(0.0, 0.0, 10.0), 1.0);
    let moved = |ordinal| if ordinal == 1 { aligned * was_at.inverse() } else { Similarity::identity() };
    folder.align(moved).expect("corrected");
    folder.finish().expect("finished");
    let text = std::fs::read_to_string(dir.path().join("trajectory_tum.txt")).expect("trajectory");
    let last = text.lines().last().expect("a line");
    assert_eq!(last, "0.500000000 5.000000000 0.000000000 9.000000000 0.000000000 0.707106781 0.000000000 0.707106781");
    assert_eq!(tum_t_z(dir.path(), "trajectory_tum.txt")[1], (0.1, 5.0), "keyframe 0 stays");
    assert_eq!(tum_t_z(dir.path(), "odometry_tum.txt")[3], (0.5, 15.0), "odometry is never corrected");
}

#[test]
fn writing_a_frame_takes_no_memory() {
    let dir = folder();
    let mut folder = OutputFolder::create(dir.path(), &Rigid::identity()).expect("created");
    let sealed = crate::seal::enter();
    for k in 0..2000_u32 {
        let written =
            folder.frame(&frame(u64::from(k), FrameStatus::Tracked, k / 2, f64::from(k % 2)), &StageTimes::default());
        assert!(written.is_ok());
    }
    assert!(folder.align(|_| Similarity::identity()).is_ok());
    assert_eq!(sealed.violations(), (0, 0));
    drop(sealed);
    assert_eq!(folder.finish().expect("finished").n_poses, 2000);
}

#[test]
fn a_full_disk_and_an_impossible_folder_are_named_with_a_way_out() {
    let dir = folder();
    std::os::unix::fs::symlink("/dev/full", dir.path().join("frames.csv")).expect("symlink");
    let complaint = drive(dir.path()).finish().expect_err("a full disk").to_string();
    assert!(complaint.contains("frames.csv") && complaint.contains("free space there"), "{complaint}");

    let file = dir.path().join("file");
    std::fs::write(&file, "").expect("file");
    let complaint = OutputFolder::create(&file.join("out"), &Rigid::identity()).expect_err("below a file").to_string();
    assert!(complaint.contains("name another one with --out"), "{complaint}");
}

#[test]
fn what_an_earlier_run_scored_is_gone_and_what_is_not_ours_stays() {
    let dir = folder();
    std::fs::create_dir(dir.path().join("renders")).expect("folder");
    let names = ["report.json", "eval.json", "renders/000001_render.jpg", "renders/mine.png", "notes.txt"];
    for name in names {
        std::fs::write(dir.path().join(name), "old").expect("written");
    }
    OutputFolder::create(dir.path(), &Rigid::identity()).expect("created");
    let left: Vec<&str> = names.into_iter().filter(|name| dir.path().join(name).exists()).collect();
    assert_eq!(left, ["renders/mine.png", "notes.txt"]);
}
