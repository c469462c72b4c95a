//! Is the odometry as wrong as it says?

use kilogs_camera::sim::{SimArgs, Simulator};
use kilogs_camera::source::FrameSource;
use kilogs_core::conventions::Rigid;
use kilogs_core::frame::ImageView;
use kilogs_core::tracking::FrameReport;
use kilogs_tests::tracker::with_tracker;
use kilogs_tests::truth::world_from_camera;
use nalgebra::Vector6;
use std::f64::consts::TAU;
use std::path::Path;

const SIZE: [u32; 2] = [416, 128];

/// Three drives that nothing was fitted to: `CLAIM_FACTOR` (core/src/tracking/drift.rs) is from the towns 1 and 2 at 10
/// frames a second. A town with corners at 5 to 9 m/s, another one with smaller steps, and a road that winds at 12 m/s.
fn drives(folder: &Path) -> [(&'static str, SimArgs); 3] {
    let common = SimArgs { length: 200.0, width: SIZE[0], height: SIZE[1], mono: true, ..SimArgs::default() };
    let way = folder.join("winding.txt");
    std::fs::write(&way, winding_poses(1.2, 200)).expect("a temporary folder");
    [
        ("town 3", SimArgs { seed: 3, ..common.clone() }),
        ("town 7 at 15 frames a second", SimArgs { seed: 7, fps: 15.0, ..common.clone() }),
        ("winding road", SimArgs { seed: 9, path: Some(way), ..common }),
    ]
}

/// A road whose bends follow each other every 60 m, the tightest with a radius of 50 m, as KITTI poses.
fn winding_poses(step_m: f64, n_frames: u32) -> String {
    const TIGHTEST_PER_M: f64 = 0.02;
    const PERIOD_M: f64 = 120.0;
    let (mut x, mut z, mut heading_rad) = (0.0, 0.0, 0.0f64);
    let pose = |frame: u32| {
        let (sin, cos) = heading_rad.sin_cos();
        let line = format!("{cos} 0 {sin} {x} 0 1 0 0 {} 0 {cos} {z}\n", -sin);
        heading_rad += TIGHTEST_PER_M * (TAU * f64::from(frame) * step_m / PERIOD_M).sin() * step_m;
        (x, z) = (x + step_m * heading_rad.sin(), z + step_m * heading_rad.cos());
        line
    };
    (0..n_frames).map(pose).collect()
}

/// A drive as grey images, with where they were taken.
fn drive(args: &SimArgs) -> (Simulator, Vec<Vec<u8>>, Vec<Rigid>) {
    let mut simulator = Simulator::new(args).expect("a drive");
    let n = simulator.n_frames();
    let mut images = vec![vec![0; (SIZE[0] * SIZE[1]) as usize]; n];
    for image in &mut images {
        simulator.next_frame(image).expect("no file is involved").expect("within the drive");
    }
    let truth = (0..n).map(|frame| world_from_camera(&simulator.camera_at(frame))).collect();
    (simulator, images, truth)
}

fn tracked(simulator: &Simulator, fps: f64, images: &[Vec<u8>]) -> Vec<FrameReport> {
    let format = simulator.format();
    let frame_ns = (1e9 / fps) as u64;
    let (width, height) = (SIZE[0] as usize, SIZE[1] as usize);
    with_tracker(format.camera, format.mounting.expect("the simulator knows"), 1, |tracker| {
        let step = |(i, image): (usize, &Vec<u8>)| {
            let image = ImageView::new(image, width, height, width).expect("size");
            tracker.step(image, i as u64, (i as u64 + 1) * frame_ns)
        };
        images.iter().enumerate().map(step).collect()
    })
}

/// The error as the covariance means it: `[theta, p]` along the axes of the odometry frame.
fn error(estimated: &Rigid, truth: &Rigid) -> Vector6<f64> {
    let theta = (truth.rotation * estimated.rotation.inverse()).scaled_axis();
    let p = truth.translation.vector - estimated.translation.vector;
    Vector6::new(theta.x, theta.y, theta.z, p.x, p.y, p.z)
}

/// Frames of a segment: 10 to 36 m of the simulated drives, corners included.
const N_FRAMES: usize = 30;

/// Mean of the squared normalised errors over their degrees of freedom: 1 where the covariance is exact. A program that
/// claims errors half as large as they are comes out 4 times as high, and one that claims twice as large, at a quarter.
const BAND: [f64; 2] = [0.4, 2.5];

/// The 95 % quantile of the chi-square distribution with six degrees of freedom, and the fewest of all segments that
/// may lie below it: corners, where tracks are lost fast, are worse than claimed (four or five sigmas sideways in some).
/// On drives that nothing was fitted to, mean and share are 1.47 and 0.81 (36 segments: towns 3 to 6), 0.88 and 0.92 (25:
/// towns 7 and 8 at 15 frames a second), 0.69 and 1.00 (6: the winding road); on the towns of the fit, 1.45 and 0.88.
const CHI_SQUARE_95: f64 = 12.59;
const MIN_SHARE_BELOW: f64 = 0.75;

#[test]
fn errors_are_as_large_as_the_covariance_says() {
    let mut normalized = Vec::new();
    let folder = tempfile::tempdir().expect("a temporary folder");
    for (name, args) in drives(folder.path()) {
        let (simulator, images, truth) = drive(&args);
        for start in (0..images.len() - N_FRAMES).step_by(N_FRAMES) {
            let reports = tracked(&simulator, args.fps, &images[start..start + N_FRAMES]);
            let last = reports.last().expect("frames");
            let first_from_last = truth[start].inverse() * truth[start + N_FRAMES - 1];
            let e = error(&last.world_from_camera, &first_from_last);
            let squared = e.dot(&last.covariance.cholesky().expect("positive definite").solve(&e));
            let sigmas = Vector6::from_fn(|k, _| last.covariance[(k, k)].sqrt());
            println!("{name} from {start}: {squared:.1}; errors in sigmas {:.2}", e.component_div(&sigmas).transpose());
            normalized.push(squared);
        }
    }
    let mean = normalized.iter().sum::<f64>() / (6.0 * normalized.len() as f64);
    let share_below = normalized.iter().filter(|&&n| n < CHI_SQUARE_95).count() as f64 / normalized.len() as f64;
    println!(
        "{} segments: normalised error {mean:.2}, {share_below:.2} of them below the 95 % quantile",
        normalized.len()
    );
    assert!(normalized.len() >= 24, "{}", normalized.len());
    assert!((BAND[0]..BAND[1]).contains(&mean), "{mean}: {normalized:?}");
    assert!(share_below >= MIN_SHARE_BELOW, "{share_below}: {normalized:?}");
}
