//! The whole way from two images to matches, through the thread.

use super::*;
use kilogs_core::correspondence::{ImagePair, PixelMatch};
use kilogs_core::frame::pyramid::bytes_needed;
use kilogs_core::frame::{ImageView, Pyramid};
use kilogs_core::math::Rng;
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

const LEVELS: usize = 4;
pub(super) const CAPACITY: usize = 2048;

pub(super) fn settings(max_width_px: usize) -> InferenceSettings {
    InferenceSettings { models: PathBuf::new(), max_width_px, deadline: Duration::from_secs(60) }
}

pub(super) fn wanted(settings: &InferenceSettings, image: (usize, usize)) -> Wanted<'_> {
    Wanted {
        matcher: Matcher::XFeat,
        dense: false,
        depth: false,
        settings,
        image,
        focal_px: 718.856,
        capacity: CAPACITY,
        cap_bytes: 1 << 30,
        is_live: false,
    }
}

/// A grey image on a pyramid of its own.
pub(super) fn pyramid(pixels: &[u8], (width, height): (usize, usize)) -> Pyramid<'static> {
    let storage = vec![0; bytes_needed(width, height, LEVELS)].leak();
    let mut pyramid = Pyramid::new(storage, width, height, LEVELS).expect("asked for its size");
    pyramid.build(ImageView::new(pixels, width, height, width).expect("sized")).expect("same size");
    pyramid
}

/// Matches of a pair by a fresh domain, with what the thread counted.
fn matches_of(matcher: &mut (dyn PairMatcher + Send), pair: (&Pyramid<'_>, u32, &Pyramid<'_>)) -> Vec<PixelMatch> {
    let mut matches = vec![PixelMatch::default(); CAPACITY];
    let pair = ImagePair { keyframe: pair.0, keyframe_ordinal: pair.1, current: pair.2 };
    let n = matcher.match_pair(&pair, &mut matches);
    matches.truncate(n);
    matches
}

/// Rectangles of random grey, and the same picture enlarged about its middle and moved.
struct Warp {
    size: (usize, usize),
    scale: f32,
    moved_px: [f32; 2],
}

impl Warp {
    fn target_px(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (cx, cy) = (0.5 * self.size.0 as f32, 0.5 * self.size.1 as f32);
        [cx + (x - cx) * self.scale + self.moved_px[0], cy + (y - cy) * self.scale + self.moved_px[1]]
    }

    fn source_px(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (cx, cy) = (0.5 * self.size.0 as f32, 0.5 * self.size.1 as f32);
        [cx + (x - self.moved_px[0] - cx) / self.scale, cy + (y - self.moved_px[1] - cy) / self.scale]
    }

    /// The picture before and after, each sampled four times per pixel.
    fn images(&self, seed: u64) -> [Vec<u8>; 2] {
        let mut rng = Rng::new(seed, 0, 0);
        let mut unit = || rng.unit_f32();
        let rectangles: Vec<[f32; 5]> = (0..400)
            .map(|_| {
                let (w, h) = (4.0 + 36.0 * unit(), 4.0 + 36.0 * unit());
                let (x, y) = (unit() * (self.size.0 as f32 + 40.0) - 20.0, unit() * (self.size.1 as f32 + 40.0) - 20.0);
                [x, y, x + w, y + h, 255.0 * unit()]
            })
            .collect();
        let grey = |[x, y]: [f32; 2]| {
            let covers = |r: &&[f32; 5]| x >= r[0] && y >= r[1] && x < r[2] && y < r[3];
            rectangles.iter().rev().find(covers).map_or(100.0, |r| r[4])
        };
        let image = |source: &dyn Fn([f32; 2]) -> [f32; 2]| {
            let pixels = (0..self.size.0 * self.size.1).map(|i| ((i % self.size.0) as f32, (i / self.size.0) as f32));
            let sample = |(x, y): (f32, f32)| {
                let places = [(0.25, 0.25), (0.75, 0.25), (0.25, 0.75), (0.75, 0.75)];
                (places.iter().map(|(u, v)| grey(source([x + u, y + v]))).sum::<f32>() / 4.0) as u8
            };
            pixels.map(sample).collect()
        };
        [image(&|px| px), image(&|px| self.source_px(px))]
    }
}

fn median(mut values: Vec<f32>) -> f32 {
    values.sort_by(f32::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f32::NAN)
}

#[test]
fn a_picture_that_is_enlarged_and_moved_is_matched() {
    let check = |dense: bool, size: (usize, usize), max_width_px, least: usize, worst_px: f32| {
        let mut settings = settings(max_width_px);
        if size.0 <= 200 {
            // A network for pairs of images, whose descriptors are patches.
            settings.models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/models");
        }
        let matcher = if size.0 <= 200 { Matcher::Classical } else { Matcher::XFeat };
        let mut domain = Domain::open(&Wanted { dense, matcher, ..wanted(&settings, size) });
        let counts = Arc::clone(&domain.counts);
        let matcher = if dense { &mut domain.dense } else { &mut domain.sparse };
        let matcher = matcher.as_deref_mut().expect("models/ is part of the source tree");
        let warp = Warp { size, scale: 1.06, moved_px: [9.3, -4.6] };
        let [before, after] = warp.images(7).map(|pixels| pyramid(&pixels, size));
        let matches = matches_of(matcher, (&before, 1, &after));
        let errors_px = matches.iter().map(|m| {
            let [x, y] = warp.target_px(m.keyframe_px);
            (x - m.current_px[0]).hypot(y - m.current_px[1])
        });
        let error_px = median(errors_px.collect());
        let mib = counts.peak_bytes.load(Relaxed) >> 20;
        println!("dense {dense}, {size:?}: {} matches, median {error_px:.2} px, {mib} MiB", matches.len());
        assert!(matches.len() >= least && error_px < worst_px, "{} matches, {error_px} px", matches.len());
        assert!(matches.windows(2).all(|two| two[0].confidence >= two[1].confidence), "the most certain first");
        assert_eq!(matches, matches_of(matcher, (&before, 1, &after)), "the same again");
    };
    check(false, (620, 188), 1248, 300, 0.5);
    check(false, (900, 270), 640, 200, 0.8);
    // Most of the grid is as exact as its network: to some pixels of a cell of 8.
    check(true, (620, 188), 1248, 500, 4.0);
    check(true, (160, 96), 1248, 300, 0.5);
    // In the network half a pixel is one of the camera's.
    check(true, (200, 120), 1248, 300, 0.8);
}

/// Centres of two cameras and their relative orientation from `poses.txt` of a KITTI recording: `R` and `t` of
/// `second_from_first`.
fn second_from_first(poses: &[nalgebra::Isometry3<f64>], first: usize, second: usize) -> nalgebra::Isometry3<f64> {
    poses[second].inverse() * poses[first]
}

fn kitti() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../shared/data/kitti04-full");
    if !folder.is_dir() {
        println!("LEFT OUT: no recording in {}", folder.display());
        return None;
    }
    Some(folder)
}

fn kitti_poses(folder: &Path) -> Vec<nalgebra::Isometry3<f64>> {
    let text = std::fs::read_to_string(folder.join("poses.txt")).expect("poses.txt");
    text.lines()
        .map(|line| {
            let n: Vec<f64> = line.split_whitespace().filter_map(|word| word.parse().ok()).collect();
            let rotation = nalgebra::Matrix3::new(n[0], n[1], n[2], n[4], n[5], n[6], n[8], n[9], n[10]);
            let rotation = nalgebra::UnitQuaternion::from_matrix(&rotation);
            nalgebra::Isometry3::from_parts(nalgebra::Translation3::new(n[3], n[7], n[11]), rotation)
        })
        .collect()
}

fn kitti_image(folder: &Path, index: usize) -> (Pyramid<'static>, (usize, usize)) {
    let file = ["png", "jpg"].map(|ending| folder.join(format!("images/{index:06}.{ending}")));
    let file = file.into_iter().find(|file| file.is_file()).expect("an image");
    let image = image::open(file).expect("readable").to_luma8();
    let size = (image.width() as usize, image.height() as usize);
    (pyramid(&image.into_raw(), size), size)
}

/// Sampson distance of each match from the epipolar geometry of two true poses, px.
fn epipolar_errors_px(folder: &Path, (first, second): (usize, usize), matches: &[PixelMatch]) -> Vec<f32> {
    let calib = std::fs::read_to_string(folder.join("calib.txt")).expect("calib.txt");
    let row = calib.lines().find(|line| line.starts_with("P0:") || line.starts_with("P2:")).expect("P0 or P2");
    let p: Vec<f64> = row.split_whitespace().skip(1).filter_map(|word| word.parse().ok()).collect();
    let k = nalgebra::Matrix3::new(p[0], 0.0, p[2] + 0.5, 0.0, p[5], p[6] + 0.5, 0.0, 0.0, 1.0);
    let motion = second_from_first(&kitti_poses(folder), first, second);
    let essential = motion.translation.vector.cross_matrix() * motion.rotation.to_rotation_matrix();
    let k_inverse = k.try_inverse().expect("a camera");
    let fundamental = k_inverse.transpose() * essential * k_inverse;
    let at = |px: [f32; 2]| nalgebra::Vector3::new(f64::from(px[0]), f64::from(px[1]), 1.0);
    matches
        .iter()
        .map(|m| {
            let (x, y) = (at(m.keyframe_px), at(m.current_px));
            let (line, back) = (fundamental * x, fundamental.transpose() * y);
            let scale = line.x.powi(2) + line.y.powi(2) + back.x.powi(2) + back.y.powi(2);
            (y.dot(&line).abs() / scale.sqrt()) as f32
        })
        .collect()
}

#[test]
fn frames_of_a_drive_are_matched_along_their_epipolar_lines() {
    let Some(folder) = kitti() else { return };
    let check = |what: &str, max_width_px: usize, apart: usize, least: usize, worst_px: f32| {
        let (first, second) = (30, 30 + apart);
        let ((before, size), (after, _)) = (kitti_image(&folder, first), kitti_image(&folder, second));
        let settings = settings(max_width_px);
        let dense = what == "dense";
        let matcher = if what == "disk" { Matcher::Disk } else { Matcher::XFeat };
        let mut domain = Domain::open(&Wanted { dense, matcher, ..wanted(&settings, size) });
        let (counts, matcher) =
            (Arc::clone(&domain.counts), if dense { &mut domain.dense } else { &mut domain.sparse });
        let matcher = matcher.as_deref_mut().expect("models/ is part of the source tree");
        let started = Instant::now();
        let matches = matches_of(matcher, (&before, 1, &after));
        let first_ms = started.elapsed().as_millis();
        let started = Instant::now();
        assert_eq!(matches, matches_of(matcher, (&before, 1, &after)));
        let again_ms = started.elapsed().as_millis();
        let errors_px = epipolar_errors_px(&folder, (first, second), &matches);
        let within = errors_px.iter().filter(|e| **e < 1.0).count();
        let error_px = median(errors_px);
        let mib = counts.peak_bytes.load(Relaxed) as f32 / (1 << 20) as f32;
        println!(
            "{what} up to {max_width_px} px, {apart} apart: {} matches, {within} within 1 px, median {error_px:.3} px; \
             {first_ms} ms, {again_ms} ms with the keyframe known; {mib:.1} MiB",
            matches.len()
        );
        assert!(matches.len() >= least && error_px < worst_px, "{what} {apart}: {} matches", matches.len());
    };
    for apart in [1, 3, 10] {
        check("sparse", 1248, apart, 100, 1.2);
        check("sparse", 640, apart, 100, 2.0);
        check("dense", 1248, apart, 500, 5.0);
    }
    // The paper's choice is not shipped.
    let models = Path::new(env!("CARGO_MANIFEST_DIR")).join("../models");
    match models.join("disk_640x192.onnx").is_file() {
        true => check("disk", 640, 1, 100, 2.0),
        false => println!("LEFT OUT: DISK + LightGlue; make them with python3 models/export.py disk"),
    }
}
