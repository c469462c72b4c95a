//! Holds our figures to those of `evo` 1.38.1 and scikit-image, stored in `data/figures.json` together with
//! the trajectories and images they belong to (`data/make_figures.py` made all of them).

use kilogs_eval::align::Freedom;
use kilogs_eval::associate::by_time;
use kilogs_eval::ate::ate;
use kilogs_eval::image_quality::{ImageQualityMeter, ImageShape};
use kilogs_eval::rpe::rpe;
use kilogs_eval::segments::segment_errors;
use kilogs_eval::trajectory::read_tum;
use serde_json::Value;
use std::path::PathBuf;

const TOLERANCE: f64 = 1e-6;

fn data(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn stored(kind: &str) -> Vec<Value> {
    let text = std::fs::read_to_string(data("figures.json")).expect("stored figures");
    let figures: Value = serde_json::from_str(&text).expect("JSON");
    figures[kind].as_array().expect("a list of figures").clone()
}

fn check(expected: &Value, key: &str, found: f64) {
    let wanted = expected[key].as_f64().unwrap_or_else(|| panic!("{key} is not stored"));
    assert!((found - wanted).abs() < TOLERANCE, "{} {key}: {found}, stored {wanted}", expected["name"]);
}

#[test]
fn trajectory_figures_equal_those_of_evo() {
    let all = stored("trajectories");
    assert_eq!(all.len(), 3);
    for expected in all {
        let read = |what: &str| {
            let name = expected["name"].as_str().expect("a name");
            read_tum(&data(&format!("{name}_{what}.txt"))).expect("stored trajectory")
        };
        let pairs = by_time(&read("estimate"), &read("truth"));
        assert_eq!(Some(pairs.len() as u64), expected["n"].as_u64());
        for (freedom, key) in [(Freedom::Se3, "ate_se3"), (Freedom::Sim3, "ate_sim3")] {
            let ate = ate(&pairs, freedom).expect("aligned");
            check(&expected, &format!("{key}_m"), ate.rmse_m);
            check(&expected, &format!("{key}_max_m"), ate.max_m);
            if freedom == Freedom::Sim3 {
                check(&expected, "scale", ate.alignment.scale);
            }
        }
        for (delta, key) in [(1, "rpe"), (10, "rpe10")] {
            let rpe = rpe(&pairs, delta).expect("long enough");
            check(&expected, &format!("{key}_translation_m"), rpe.translation_rmse_m);
            check(&expected, &format!("{key}_rotation_deg"), rpe.rotation_rmse_deg);
        }
        let segments = segment_errors(&pairs).expect("long enough");
        assert_eq!(Some(segments.n as u64), expected["n_segments"].as_u64());
        check(&expected, "segment_translation_percent", segments.translation_percent);
        check(&expected, "segment_rotation_deg_per_100m", segments.rotation_deg_per_100m);
    }
}

#[test]
fn image_figures_equal_those_of_scikit_image() {
    let all = stored("images");
    assert_eq!(all.len(), 2);
    for expected in all {
        let read = |what: &str| {
            let name = expected["name"].as_str().expect("a name");
            read_pnm(&std::fs::read(data(&format!("{name}_{what}.pnm"))).expect("stored image"))
        };
        let ((shape, camera), (_, rendered)) = (read("camera"), read("rendered"));
        let mut meter = ImageQualityMeter::new(shape);
        let as_floats: Vec<f32> = rendered.iter().map(|&byte| f32::from(byte) / 255.0).collect();
        // Twice each: a meter carries nothing over from one image to the next.
        for _ in 0..2 {
            let from_bytes = meter.judge(&rendered, &camera).expect("judged");
            let from_floats = meter.judge(&as_floats, &camera).expect("judged");
            for quality in [from_bytes, from_floats] {
                check(&expected, "psnr_db", quality.psnr_db);
                check(&expected, "ssim", quality.ssim);
            }
        }
    }
}

/// Reads the binary grey (P5) and color (P6) images that `make_figures.py` writes.
fn read_pnm(bytes: &[u8]) -> (ImageShape, Vec<u8>) {
    let mut lines = bytes.splitn(4, |&byte| byte == b'\n');
    let mut text = || std::str::from_utf8(lines.next().expect("a line")).expect("text").to_owned();
    let (magic, size, _) = (text(), text(), text());
    let (width, height) = size.split_once(' ').expect("two numbers");
    let channels = if magic == "P5" { 1 } else { 3 };
    let shape = ImageShape { width: width.parse().expect("width"), height: height.parse().expect("height"), channels };
    (shape, lines.next().expect("pixels").to_vec())
}
