//! Is the odometry as wrong as it says?

use kilogs_camera::sim::{SimArgs, Simulator, Waypoint};
use kilogs_camera::source::FrameSource;
use kilogs_core::conventions::Rigid;
use kilogs_core::frame::ImageView;
use kilogs_core::tracking::FrameReport;
use kilogs_tests::tracker::with_tracker;
use nalgebra::{Translation3, UnitQuaternion, Vector3, Vector6};

const SIZE: [u32; 2] = [416, 128];

fn world_from_camera(at: &Waypoint) -> Rigid {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * at.heading_rad);
    Rigid::from_parts(Translation3::new(at.x, 0.0, at.z), turn)
}

/// A drive as grey images, with where they were taken.
fn drive(seed: u64, length_m: f64) -> (Simulator, Vec<Vec<u8>>, Vec<Rigid>) {
    let args = SimArgs { seed, length: length_m, width: SIZE[0], height: SIZE[1], mono: true, ..SimArgs::default() };
    let mut simulator = Simulator::new(&args).expect("a generated drive");
    let n = simulator.n_frames();
    let mut images = vec![vec![0; (SIZE[0] * SIZE[1]) as usize]; n];
    for image in &mut images {
        simulator.next_frame(image).expect("no file is involved").expect("within the drive");
    }
    let truth = (0..n).map(|frame| world_from_camera(&simulator.camera_at(frame))).collect();
    (simulator, images, truth)
}

fn tracked(simulator: &Simulator, images: &[Vec<u8>]) -> Vec<FrameReport> {
    let format = simulator.format();
    let (width, height) = (SIZE[0] as usize, SIZE[1] as usize);
    with_tracker(format.camera, format.mounting.expect("the simulator knows"), 1, |tracker| {
        let step = |(i, image): (usize, &Vec<u8>)| {
            let image = ImageView::new(image, width, height, width).expect("size");
            tracker.step(image, i as u64, (i as u64 + 1) * 100_000_000)
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

/// Frames of a segment: 14 to 26 m of the simulated drives, corners included.
const N_FRAMES: usize = 30;

/// Mean of the squared normalised errors over their degrees of freedom: 1 where the covariance is exact. A program that
/// claims errors half as large as they are comes out 4 times as high, and one that claims twice as large, at a quarter.
const BAND: [f64; 2] = [0.4, 2.5];

/// The 95 % quantile of the chi-square distribution with six degrees of freedom, and the fewest of all segments that
/// may lie below it: corners, where tracks are lost fast, are worse than claimed.
const CHI_SQUARE_95: f64 = 12.59;
const MIN_SHARE_BELOW: f64 = 0.75;

#[test]
fn errors_are_as_large_as_the_covariance_says() {
    let mut normalized = Vec::new();
    for seed in [1, 2] {
        let (simulator, images, truth) = drive(seed, 200.0);
        for start in (0..images.len() - N_FRAMES).step_by(N_FRAMES) {
            let reports = tracked(&simulator, &images[start..start + N_FRAMES]);
            let last = reports.last().expect("frames");
            let first_from_last = truth[start].inverse() * truth[start + N_FRAMES - 1];
            let e = error(&last.world_from_camera, &first_from_last);
            let squared = e.dot(&last.covariance.cholesky().expect("positive definite").solve(&e));
            let sigmas = Vector6::from_fn(|k, _| last.covariance[(k, k)].sqrt());
            println!(
                "seed {seed} from {start}: {squared:.1}; errors in sigmas {:.2}",
                e.component_div(&sigmas).transpose()
            );
            normalized.push(squared);
        }
    }
    let mean = normalized.iter().sum::<f64>() / (6.0 * normalized.len() as f64);
    let share_below = normalized.iter().filter(|&&n| n < CHI_SQUARE_95).count() as f64 / normalized.len() as f64;
    println!(
        "{} segments: normalised error {mean:.2}, {share_below:.2} of them below the 95 % quantile",
        normalized.len()
    );
    assert!(normalized.len() >= 12, "{}", normalized.len());
    assert!((BAND[0]..BAND[1]).contains(&mean), "{mean}: {normalized:?}");
    assert!(share_below >= MIN_SHARE_BELOW, "{share_below}: {normalized:?}");
}
