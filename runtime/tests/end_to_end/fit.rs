//! Maps from images whose places are known.

use crate::drive::{Drive, files, write};
use crate::program::{kilogs, kilogs_succeeds, word};
use crate::replay::{check_counts, count, json, number};
use std::path::{Path, PathBuf};

/// The recording with the camera's axes turned to OpenGL's, as nerfstudio writes it. `spoil` may change the text.
fn transforms(drive: &Drive, spoil: impl Fn(String) -> String) -> PathBuf {
    let numbers = |text: String| -> Vec<f64> { text.split_whitespace().filter_map(|word| word.parse().ok()).collect() };
    let read = |name: &str| std::fs::read_to_string(drive.file(name)).expect("a text file");
    let row = numbers(read("calib.txt"));
    let frames: Vec<String> = read("poses.txt")
        .lines()
        .enumerate()
        .map(|(index, line)| {
            let m = numbers(line.to_owned());
            let rows: Vec<String> = m
                .chunks(4)
                .map(|row| format!("[{}, {}, {}, {}]", row[0], -row[1], -row[2], row[3]))
                .chain(["[0, 0, 0, 1]".to_owned()])
                .collect();
            format!("{{\"file_path\": \"images/{index:06}.png\", \"transform_matrix\": [{}]}}", rows.join(", "))
        })
        .collect();
    let (fx, fy, cx, cy) = (row[0], row[5], row[2] + 0.5, row[6] + 0.5);
    let text = format!(
        "{{\"camera_model\": \"OPENCV\", \"fl_x\": {fx}, \"fl_y\": {fy}, \"cx\": {cx}, \"cy\": {cy}, \"w\": 416, \
         \"h\": 128, \"k1\": 0.0, \"ply_file_path\": \"points.ply\", \"frames\": [{}]}}",
        frames.join(",\n")
    );
    let ply = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n\
               property uchar red\nend_header\n0 1.65 9 7\n1 1.65 8 7\n";
    write(&drive.file("points.ply"), ply);
    let path = drive.file("transforms.json");
    write(&path, spoil(text));
    path
}

fn fit(scene: &Path, out: &Path, options: &[&str]) {
    let (scene, out) = (word(scene), word(out));
    kilogs_succeeds([&["fit", &scene, "--out", &out], options].concat());
}

/// Fits the recording with its truth, and says what the held-out views score.
fn fit_drive(drive: &Drive, out: &Path, options: &[&str]) -> f64 {
    let poses = word(&drive.file("poses.txt"));
    fit(drive.path(), out, &[&["--poses", &poses], options].concat());
    let report = json(&out.join("report.json"));
    check_counts(&report);
    let n_images = count(&report, "/frames/received");
    assert_eq!(count(&report, "/frames/keyframes"), n_images - n_images / 8, "{report}");
    number(&report, "/mapping/psnr_heldout_db")
}

#[test]
fn training_helps_and_gives_the_same_bytes_again() {
    let (drive, out) = (Drive::new(20.0), tempfile::tempdir().expect("a folder"));
    let path = |name: &str| out.path().join(name);
    let little_db = fit_drive(&drive, &path("little"), &["--iterations", "1", "--threads", "1"]);
    let long_db = fit_drive(&drive, &path("long"), &["--iterations", "400", "--threads", "1"]);
    let again_db = fit_drive(&drive, &path("again"), &["--iterations", "400", "--threads", "2"]);
    println!("held out: {little_db:.2} dB as inserted, {long_db:.2} dB after 400 steps");
    assert!(long_db > little_db + 1.0, "{little_db} dB, then {long_db} dB");
    assert_eq!(long_db, again_db);
    assert!(files(&path("long/map")) == files(&path("again/map")), "same input, same bytes");
    for name in ["report.html", "trajectory_tum.txt", "keyframes_tum.txt", "frames.csv"] {
        assert!(path("long").join(name).is_file(), "{name}");
    }
    let renders = files(&path("long/renders"));
    assert!(!renders.is_empty(), "no pictures");

    let scene = transforms(&drive, |text| text);
    fit(&scene, &path("transforms"), &["--iterations", "400"]);
    let transforms_db = number(&json(&path("transforms/report.json")), "/mapping/psnr_heldout_db");
    println!("held out: {transforms_db:.2} dB from transforms.json");
    assert!((transforms_db - long_db).abs() < 1.0, "{transforms_db} dB, {long_db} dB with poses.txt");

    // A pool that cannot hold the scene: it is fitted in sections.
    let sections = ["--iterations", "200", "--max-gaussians", "20000"];
    let sections_db = fit_drive(&drive, &path("sections"), &sections);
    println!("held out: {sections_db:.2} dB in sections");
    assert!(sections_db > little_db, "{sections_db} dB, {little_db} dB as inserted");
    let in_memory = count(&json(&path("sections/report.json")), "/mapping/anchors_resident");
    assert!(in_memory <= 10_000, "{in_memory} anchors");

    // The figures of a run follow its map.
    let (run, truth) = (word(&path("little")), word(&drive.file("poses.txt")));
    kilogs_succeeds(["eval", &run, "--gt", &truth]);
    kilogs_succeeds(["refine", &run, "--iterations", "200"]);
    assert!(!path("little/eval.json").exists(), "it is of the map before");
    let refined_db = number(&json(&path("little/report.json")), "/mapping/psnr_heldout_db");
    assert!(refined_db > little_db, "{refined_db} dB, {little_db} dB before");
    let page = std::fs::read_to_string(path("little/report.html")).expect("a page");
    assert!(page.contains(&format!("held out {refined_db:.2} dB")) && page.contains("<h2>Camera and map</h2>"));
    kilogs_succeeds(["eval", &run, "--gt", &truth]);
    assert_eq!(number(&json(&path("little/eval.json")), "/psnr_heldout_db"), refined_db);
    let views = std::fs::read_to_string(path("little/views.csv")).expect("a table");
    let held_out: Vec<f64> = views
        .lines()
        .map(|line| line.split(',').collect::<Vec<_>>())
        .filter(|row| row[3] == "1")
        .map(|row| row[5].parse().expect("a number"))
        .collect();
    let mean_of = |value: fn(f64) -> f64| held_out.iter().copied().map(value).sum::<f64>() / held_out.len() as f64;
    let mean_db = mean_of(|db| db);
    assert!((mean_db - refined_db).abs() < 0.01, "{mean_db} dB in the table, {refined_db} dB in the report");

    // A network that says what the PSNR says.
    let models = word(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/models"));
    kilogs_succeeds(["eval", &run, "--gt", &truth, "--set", &format!("inference.models={models}")]);
    let judged = json(&path("little/eval.json"));
    let (lpips, expected) = (number(&judged, "/lpips_heldout"), mean_of(|db| 10_f64.powf(-db / 10.0)));
    assert!((lpips / expected - 1.0).abs() < 1e-3, "{lpips}, expected {expected}");
    assert!(number(&judged, "/lpips_train") > 0.0);
}

#[test]
fn scenes_that_cannot_be_used_are_refused() {
    let (drive, out) = (Drive::new(3.0), tempfile::tempdir().expect("a folder"));
    let out = word(&out.path().join("run"));
    let check = |scene: &Path, options: &[&str], code: i32, text: &str| {
        let scene = word(scene);
        let ended = kilogs([&["fit", &scene, "--out", &out, "--iterations", "1"], options].concat());
        let said = ended.stderr.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(ended.code == Some(code) && said.contains(text), "{options:?}: not {code} and \"{text}\": {ended:?}");
    };
    check(drive.path(), &[], 3, "there is no transforms.json in it");
    check(&drive.file("nothing"), &[], 3, "there is no such file or folder");
    let with = |spoil: &dyn Fn(String) -> String, text: &str| check(&transforms(&drive, spoil), &[], 3, text);
    with(&|text| text[..text.len() / 2].to_owned(), "expected nerfstudio's transforms.json");
    with(&|_| "{\"fl_x\": 1, \"frames\": []}".to_owned(), "frames is empty");
    with(&|text| text.replace("\"fl_x\"", "\"fl\""), "neither fl_x nor camera_angle_x");
    with(&|text| text.replace("\"k1\": 0.0", "\"k1\": 0.1"), "undistort the images first");
    with(&|text| text.replace("OPENCV", "OPENCV_FISHEYE"), "camera_model OPENCV_FISHEYE is not a pinhole");
    with(&|text| text.replace("\"w\": 416", "\"w\": 832"), "w and h are 832x128");
    with(&|text| text.replacen("[[", "[[9", 1), "does not hold a rotation");
    with(&|text| text.replacen("[[", "[[NaN, ", 1), "expected nerfstudio's transforms.json");
    with(&|text| text.replacen("[[", "[[7, ", 1), "is not 4x4");
    with(&|text| text.replace("000001.png", "999999.png"), "999999.png");
    with(&|text| text.replace("points.ply", "no.ply"), "leave ply_file_path out");
    check(&transforms(&drive, |text| text), &["--max-gaussians", "999999999"], 2, "--max-gaussians");

    let poses = std::fs::read_to_string(drive.file("poses.txt")).expect("poses");
    let lines: Vec<&str> = poses.lines().collect();
    let bad = word(&drive.file("bad.txt"));
    let posed = |lines: &[&str], text: &str| {
        write(Path::new(&bad), lines.join("\n"));
        check(drive.path(), &["--poses", &bad], 3, text);
        let replay = ["replay", &word(drive.path()), "--out", &out, "--poses", &bad];
        let ended = kilogs(replay);
        assert!(ended.code == Some(3) && ended.stderr.contains(text), "replay: not 3 and \"{text}\": {ended:?}");
    };
    posed(&lines[..2], "and none for 000002.png");
    posed(
        &[&["nan 0 0 0 0 1 0 0 0 0 1 0"], &lines[1..]].concat(),
        "line 1 holds something that is not a finite number",
    );
    posed(&[&["1 1 0 0 0 1 0 0 0 0 1 0"], &lines[1..]].concat(), "line 1 does not hold a rotation");
    check(drive.path(), &["--poses", &word(&drive.file("no.txt"))], 3, "no.txt");

    image::RgbImage::new(200, 128).save(drive.image(2)).expect("an image");
    let truth = word(&drive.file("poses.txt"));
    check(drive.path(), &["--poses", &truth], 3, "000002.png: the image has 200x128 px");
    check(&transforms(&drive, |text| text), &[], 3, "000002.png: the image has 200x128 px");
}

#[test]
fn a_replay_maps_with_given_poses() {
    let (drive, out) = (Drive::new(12.0), tempfile::tempdir().expect("a folder"));
    let (dataset, poses) = (word(drive.path()), word(&drive.file("poses.txt")));
    let run = word(&out.path().join("run"));
    kilogs_succeeds(["replay", &dataset, "--out", &run, "--iterations", "2", "--poses", &poses]);
    kilogs_succeeds(["eval", &run, "--gt", &poses]);
    let eval = json(&out.path().join("run/eval.json"));
    let ate_m = number(&eval, "/ate_se3_m");
    assert!(ate_m < 1e-6, "{eval}");
    let report = json(&out.path().join("run/report.json"));
    assert_eq!(report.pointer("/tracking/scale_source").and_then(|name| name.as_str()), Some("given_poses"));
    assert!(count(&report, "/frames/keyframes") > 2, "{report}");

    // Given poses tell the scale, so the camera's height need not be known.
    std::fs::remove_file(drive.file("camera.toml")).expect("it was there");
    let unknown_height = word(&out.path().join("unknown_height"));
    kilogs_succeeds(["replay", &dataset, "--out", &unknown_height, "--iterations", "2", "--poses", &poses]);
    let other = json(&out.path().join("unknown_height/report.json"));
    let [known_db, unknown_db] = [&report, &other].map(|report| number(report, "/mapping/psnr_train_db"));
    assert!(unknown_db > known_db - 0.5, "{known_db} dB, {unknown_db} dB with unknown height");
}
