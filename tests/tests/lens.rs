//! A drive through a lens: recorded distorted, described in `camera.toml`, tracked.

use image::GrayImage;
use kilogs_camera::sim::{SimArgs, Simulator};
use kilogs_camera::source::{FolderSource, FrameSource, IndexedFrames};
use kilogs_core::camera::{Lens, Pinhole};
use kilogs_core::frame::ImageView;
use kilogs_tests::tracker::with_tracker;
use nalgebra::{Vector2, Vector3};
use std::path::Path;

const SIZE: [u32; 2] = [416, 128];
const N_FRAMES: u64 = 40;

/// What the lens shows of a picture that an ideal camera took; black where that camera saw nothing.
fn photo(lens: &Lens, camera: &Pinhole, ideal: &[u8]) -> GrayImage {
    let at = |x: f64, y: f64| f64::from(ideal[y as usize * SIZE[0] as usize + x as usize]);
    GrayImage::from_fn(SIZE[0], SIZE[1], |column, row| {
        let pixel = Vector2::new(f64::from(column) + 0.5, f64::from(row) + 0.5);
        let ray = lens.undistort(&camera.unproject_z1(&pixel));
        let Some(px) = ray.and_then(|ray| camera.project(&Vector3::new(ray.x, ray.y, 1.0))) else { return [0].into() };
        let (x, y) = (px.x - 0.5, px.y - 0.5);
        let is_inside = x >= 0.0 && y >= 0.0 && x < f64::from(SIZE[0] - 1) && y < f64::from(SIZE[1] - 1);
        if !is_inside {
            return [0].into();
        }
        let (left, top) = (x.floor(), y.floor());
        let (fx, fy) = (x - left, y - top);
        let upper = at(left, top) * (1.0 - fx) + at(left + 1.0, top) * fx;
        let lower = at(left, top + 1.0) * (1.0 - fx) + at(left + 1.0, top + 1.0) * fx;
        [(upper * (1.0 - fy) + lower * fy).round() as u8].into()
    })
}

/// Writes the drive as the lens shows it and returns how far it went, m.
fn record(folder: &Path, lens: &Lens) -> f64 {
    let args =
        SimArgs { seed: 3, frames: Some(N_FRAMES), width: SIZE[0], height: SIZE[1], mono: true, ..SimArgs::default() };
    let mut simulator = Simulator::new(&args).expect("a drive");
    let camera = simulator.format().camera;
    std::fs::create_dir(folder.join("images")).expect("a temporary folder");
    let mut pixels = vec![0; (SIZE[0] * SIZE[1]) as usize];
    for frame in 0..N_FRAMES {
        simulator.next_frame(&mut pixels).expect("no file is involved").expect("within the drive");
        let path = folder.join(format!("images/{frame:06}.png"));
        photo(lens, &camera, &pixels).save(path).expect("a temporary image");
    }
    let (first, last) = (simulator.camera_at(0), simulator.camera_at(N_FRAMES as usize - 1));
    (last.x - first.x).hypot(last.z - first.z)
}

fn describe(folder: &Path, lens: &str) {
    let camera = Simulator::new(&SimArgs { width: SIZE[0], height: SIZE[1], ..SimArgs::default() });
    let Pinhole { fx, fy, cx, cy, .. } = camera.expect("a drive").format().camera;
    let text = format!("fx = {fx:?}\nfy = {fy:?}\ncx = {cx:?}\ncy = {cy:?}\nheight_m = 1.65\n{lens}\n");
    std::fs::write(folder.join("camera.toml"), text).expect("a temporary file");
}

/// How far the tracker believes that the recording went, m.
fn tracked_distance_m(folder: &Path) -> f64 {
    let mut source = FolderSource::open(folder, None, Some(10.0)).expect("a recording");
    let format = source.format();
    let (width, height) = (SIZE[0] as usize, SIZE[1] as usize);
    let mut pixels = vec![0; width * height];
    with_tracker(format.camera, format.mounting.expect("the file tells it"), 1, |tracker| {
        let mut distance_m = 0.0;
        for frame in 0..N_FRAMES {
            source.read_frame(frame, &mut pixels).expect("an image");
            let image = ImageView::new(&pixels, width, height, width).expect("size");
            let report = tracker.step(image, frame, source.info(frame).timestamp_ns + 1);
            distance_m = report.world_from_camera.translation.vector.norm();
        }
        distance_m
    })
}

/// The lens that the tracker knows of leaves the distance right, one that it does not know of spoils it.
fn check(lens: &Lens, described: &str) {
    const WITH_LENS: f64 = 0.04;
    const FACTOR_WITHOUT: f64 = 2.0;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let truth_m = record(folder.path(), lens);
    let error = |text: &str| {
        describe(folder.path(), text);
        (tracked_distance_m(folder.path()) / truth_m - 1.0).abs()
    };
    let (with, without) = (error(described), error("model = \"pinhole\""));
    println!("{lens:?}: {truth_m:.1} m, relative error {with:.4} with the lens model, {without:.4} without");
    assert!(with < WITH_LENS, "{with}");
    assert!(without > FACTOR_WITHOUT * with, "{without} {with}");
}

#[test]
fn a_drive_through_a_lens_is_as_long_as_it_was() {
    check(
        &Lens::RadialTangential([-0.28, 0.07, 0.0002, -0.0005, 0.0]),
        "model = \"radial_tangential\"\ncoefficients = [-0.28, 0.07, 0.0002, -0.0005]",
    );
    check(
        &Lens::KannalaBrandt([0.012, -0.004, 0.0007, -0.0003]),
        "model = \"kannala_brandt\"\ncoefficients = [0.012, -0.004, 0.0007, -0.0003]",
    );
}
