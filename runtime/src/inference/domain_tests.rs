//! What is missing, wrong, too large or late is off, counted, and costs the calling thread nothing.

use super::tests::{CAPACITY, pyramid, settings, wanted};
use super::*;
use crate::seal;
use kilogs_core::correspondence::{ImagePair, PixelMatch};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

const SMALL: (usize, usize) = (320, 96);

fn models() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models")
}

fn test_models() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/models")
}

/// Grey that is not the same anywhere.
fn noise((width, height): (usize, usize)) -> Vec<u8> {
    (0..(width * height) as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect()
}

#[test]
fn the_calling_thread_takes_and_frees_nothing() {
    let mut settings = settings(640);
    let image = pyramid(&noise(SMALL), SMALL);
    let pair = ImagePair { keyframe: &image, keyframe_ordinal: 3, current: &image };
    let mut matches = vec![PixelMatch::default(); CAPACITY];
    let mut domain = Domain::open(&Wanted { dense: true, ..wanted(&settings, SMALL) });
    for matcher in [domain.sparse.as_mut(), domain.dense.as_mut()] {
        let matcher = matcher.expect("models/ is part of the source tree");
        let sealed = seal::enter();
        let n = matcher.match_pair(&pair, &mut matches);
        assert_eq!((sealed.violations(), n > 50), ((0, 0), true), "{n} matches of an image with itself");
        let few = matcher.match_pair(&pair, &mut matches[..10]);
        assert_eq!((sealed.violations(), few), ((0, 0), 10), "no room for more");
    }
    settings.models = test_models();
    let mut domain = Domain::open(&Wanted { matcher: Matcher::Classical, depth: true, ..wanted(&settings, (64, 48)) });
    let image = pyramid(&[9; 64 * 48], (64, 48));
    let depth = domain.depth.as_mut().expect("tests/models is part of the source tree");
    let mut depths_m = [0.0; 2];
    let sealed = seal::enter();
    let n = depth.depths_m(&image, &[[3.5, 30.5], [3.5, 3.5]], &mut depths_m);
    assert_eq!((sealed.violations(), n), ((0, 0), 1));
}

#[test]
fn depth_is_the_networks_in_the_cameras_pixels() {
    let mut settings = settings(640);
    settings.models = test_models();
    let check = |size: (usize, usize), grey: u8, focal_px: f32, pixel: [f32; 2], expected_m: Option<f32>| {
        let wanted = Wanted { matcher: Matcher::Classical, depth: true, focal_px, ..wanted(&settings, size) };
        let mut domain = Domain::open(&wanted);
        let image = pyramid(&vec![grey; size.0 * size.1], size);
        let mut depths_m = [0.0];
        let n = domain.depth.as_mut().expect("tests/models").depths_m(&image, &[pixel], &mut depths_m);
        assert_eq!(n, usize::from(expected_m.is_some()), "{depths_m:?}");
        if let Some(expected_m) = expected_m {
            assert!((depths_m[0] - expected_m).abs() < 1e-3 * expected_m, "{depths_m:?}, expected {expected_m}");
        }
    };
    // 60 m px below the horizon in row 16.
    check((64, 48), 9, 40.0, [20.5, 36.5], Some(60.0 / 20.5));
    check((64, 48), 200, 40.0, [20.5, 36.5], Some(2.0 * 60.0 / 20.5));
    check((64, 48), 9, 40.0, [20.5, 8.5], None);
    check((64, 48), 9, 40.0, [64.5, 36.5], None);
    // Twice the size, half of it in the network: the same rows with half the camera's focal length.
    check((128, 96), 9, 80.0, [41.0, 73.0], Some(60.0 / 20.5));
    check((128, 96), 9, 160.0, [41.0, 73.0], Some(2.0 * 60.0 / 20.5));
}

#[test]
fn what_cannot_be_used_is_off_and_counted() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for file in ["manifest.toml", "lighterglue_1024.onnx", "xfeat_640x192.onnx"] {
        std::fs::copy(models().join(file), folder.path().join(file)).expect("a copy");
    }
    let mut glue = std::fs::read(folder.path().join("lighterglue_1024.onnx")).expect("the copy");
    glue[1000] ^= 1;
    let check = |settings: &InferenceSettings, matcher: Matcher, cap_bytes: u64| {
        let domain = Domain::open(&Wanted { matcher, cap_bytes, ..wanted(settings, SMALL) });
        (domain.sparse.is_some(), domain.counts.switched_off.load(Relaxed))
    };
    let mut settings = settings(640);
    settings.models = folder.path().to_owned();
    assert_eq!(check(&settings, Matcher::XFeat, 1 << 30), (true, 0));
    assert_eq!(check(&settings, Matcher::XFeat, 1 << 20), (false, 1), "a cap that is too small");
    assert_eq!(check(&settings, Matcher::Disk, 1 << 30), (false, 1), "not shipped");
    std::fs::write(folder.path().join("lighterglue_1024.onnx"), glue).expect("written");
    assert_eq!(check(&settings, Matcher::XFeat, 1 << 30), (false, 1), "one bit is wrong");
    settings.models = "/nowhere".into();
    assert_eq!(check(&settings, Matcher::XFeat, 1 << 30), (false, 1), "no folder");
    assert_eq!(check(&settings, Matcher::Classical, 0), (false, 0), "nothing wanted");
}

#[test]
fn a_late_answer_is_no_answer() {
    let mut settings = settings(640);
    settings.deadline = Duration::from_millis(1);
    let image = pyramid(&noise(SMALL), SMALL);
    let pair = ImagePair { keyframe: &image, keyframe_ordinal: 3, current: &image };
    let mut matches = vec![PixelMatch::default(); CAPACITY];
    let mut check = |is_live: bool| {
        let mut domain = Domain::open(&Wanted { is_live, ..wanted(&settings, SMALL) });
        let n = domain.sparse.as_mut().expect("models/").match_pair(&pair, &mut matches);
        (n > 0, domain.counts.late.load(Relaxed), domain.counts.answered.load(Relaxed))
    };
    assert_eq!(check(true), (false, 1, 0));
    assert_eq!(check(false), (true, 0, 1), "in lock-step it is waited for");
}

#[test]
fn what_is_wrong_with_a_model_is_said_with_what_to_do() {
    let check = |text: &str, part: &str| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(folder.path().join("manifest.toml"), text).expect("written");
        let error = match Manifest::find(folder.path()) {
            Err(error) => error,
            Ok(manifest) => manifest.check(&manifest.rows()[0]).expect_err("no files there"),
        };
        assert!(error.to_string().contains(part), "{part:?} is not in {error}");
    };
    let shipped = std::fs::read_to_string(models().join("manifest.toml")).expect("the manifest");
    let with = |from: &str, to: &str| shipped.replacen(from, to, 1);
    check(&shipped, "make it with: python3 models/export.py xfeat");
    check(&with("xfeat_features", "oracle"), "unknown variant `oracle`");
    check(&with("[1, 3, 192, 640]", "[1, 2, 192, 640]"), "inputs [[1, 2, 192, 640]]");
    check(&with("[1, 65, 24, 80]", "[1, 64, 24, 80]"), "role \"xfeat_features\" has");
    check(&with("licence = ", "license = "), "unknown field `license`");
    let of_test = std::fs::read_to_string(test_models().join("manifest.toml")).expect("the manifest");
    check(&of_test.replace("depth = {", "# depth = {"), "depth = { .. }");
    check(&of_test.replace("std = [1.0]", "std = [0.0]"), "std above 0");
    let nowhere = Manifest::find(Path::new("/nowhere")).expect_err("no such folder").to_string();
    assert!(nowhere.contains("/nowhere") && nowhere.contains("--set inference.models=DIR"), "{nowhere}");
}

#[test]
fn every_shipped_file_is_what_its_row_says() {
    let manifest = Manifest::find(&models()).expect("the manifest");
    for row in manifest.rows() {
        let is_shipped = row.role != Role::DiskFeatures && row.role != Role::DiskMatcher;
        let verdict = manifest.check(row);
        assert!(verdict.is_ok() || !is_shipped, "{}: {:?}", row.name, verdict.err().map(|e| e.to_string()));
    }
    let files = std::fs::read_dir(models()).expect("the folder").filter_map(Result::ok).map(|entry| entry.path());
    for file in files.filter(|file| file.extension().is_some_and(|ending| ending == "onnx")) {
        let has_row = manifest.rows().iter().any(|row| file.ends_with(&row.file));
        assert!(has_row, "{} has no row in the manifest", file.display());
    }
}
