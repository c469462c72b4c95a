//! Poses from matches whose truth is known.

use super::clock::Times;
use super::median;
use super::problems::{CAMERA, NOISE_PX, Scene, TwoViews, camera_of_window, second_from_first, window};
use kilogs_core::bundle::{BundleSettings, ReducedSystem, adjust};
use kilogs_core::conventions::Rigid;
use kilogs_core::keyframe::WINDOW;
use kilogs_core::math::Rng;
use kilogs_core::pose::{
    LandmarkMatch, Match, PnpSettings, RelativePose, RelativeSettings, epnp, estimate_homography, estimate_pnp,
    estimate_relative, five_point,
};
use nalgebra::{Matrix3, Vector2, Vector3};
use std::hint::black_box;
use std::path::Path;

const MATCHES: usize = 1000;
const OUTLIER_RATIOS: [f64; 2] = [0.3, 0.6];
/// The peers' settings: 1 px, 0.999.
const RELATIVE: RelativeSettings =
    RelativeSettings { inlier_z1: 1.0 / CAMERA.fx, confidence: 0.999, trials: [20, 10_000], local_iterations: 10 };
/// The peers' settings: 2 px in one image, as much as 1.4 px over both; 0.999.
const HOMOGRAPHY: RelativeSettings =
    RelativeSettings { inlier_z1: 1.4 / CAMERA.fx, confidence: 0.999, trials: [20, 1000], local_iterations: 10 };
/// The peers' settings: 2 px, 0.999.
const PNP: PnpSettings = PnpSettings {
    noise_z1: NOISE_PX / CAMERA.fx,
    inlier_sigmas: 4.0,
    confidence: 0.999,
    trials: [20, 1000],
    iterations: 10,
};
/// Landmarks of a window in town.
const LANDMARKS: usize = 1000;
const BUNDLE: BundleSettings = BundleSettings {
    noise_z1: NOISE_PX / CAMERA.fx,
    huber_sigmas: 1.345,
    outlier_sigmas: 4.0,
    max_iterations: 8,
    min_sightings: 3,
};

fn problems(scene: Scene, outlier_ratio: f64, n_seeds: u64) -> Vec<TwoViews> {
    (0..n_seeds).map(|seed| TwoViews::new(scene, MATCHES, outlier_ratio, seed)).collect()
}

/// One file per scene and share of outliers: all problems, one after the other.
pub fn store(n_seeds: u64, folder: &Path) -> std::io::Result<()> {
    for (name, scene) in [("two_views", Scene::Space), ("plane", Scene::Plane)] {
        for ratio in OUTLIER_RATIOS {
            let bytes: Vec<u8> = problems(scene, ratio, n_seeds).iter().flat_map(TwoViews::bytes).collect();
            std::fs::write(folder.join(format!("{name}_{:.0}.f64", 100.0 * ratio)), bytes)?;
        }
    }
    Ok(())
}

fn rotation_error_deg(found: &Rigid) -> f64 {
    found.rotation.angle_to(&second_from_first().rotation).to_degrees()
}

/// The five-point solver and the robust loop around it.
pub fn print_essential(n_seeds: u64) {
    println!(
        "| relative pose | ms | rotation error, deg | direction error, deg | samples |\n|---|---:|---:|---:|---:|"
    );
    let exact = TwoViews::new(Scene::Space, MATCHES, 0.0, 0).matches();
    let samples: Vec<[Match; 5]> = exact.as_chunks().0.to_vec();
    let times = Times::of(0..20, |_| samples.iter().for_each(|sample| drop(black_box(five_point(sample)))));
    println!("| {} five-point samples, no outliers | {} | - | - | {} |", samples.len(), times.text(), samples.len());
    for ratio in OUTLIER_RATIOS {
        let problems: Vec<_> = problems(Scene::Space, ratio, n_seeds).iter().map(TwoViews::matches).collect();
        let (mut found, mut is_inlier) = (Vec::new(), vec![false; MATCHES]);
        let times = Times::of(0..problems.len(), |i| {
            let mut rng = Rng::new(1, i as u64, 1);
            found.extend(estimate_relative(&problems[i], None, &RELATIVE, &mut rng, &mut is_inlier));
        });
        let errors = |of: &dyn Fn(&RelativePose) -> f64| {
            median(found.iter().map(|estimate| of(&estimate.second_from_first)).collect())
        };
        let truth = second_from_first();
        println!(
            "| {MATCHES} matches, {:.0} % outliers, {} problems | {} | {:.4} | {:.3} | {:.0} |",
            100.0 * ratio,
            found.len(),
            times.text(),
            errors(&|pose| pose.rotation.angle_to(&truth.rotation).to_degrees()),
            errors(&|pose| pose.direction.angle(&truth.translation.vector).to_degrees()),
            median(found.iter().map(|estimate| estimate.n_trials as f64).collect())
        );
    }
    println!();
}

/// Mean distance of the exact points from where a homography puts them in the second image, px.
fn transfer_error_px(homography: &Matrix3<f64>, points: &[([f64; 2], [f64; 2], [f64; 3])]) -> f64 {
    let error = |&(_, _, point): &([f64; 2], [f64; 2], [f64; 3])| {
        let point = Vector3::from(point);
        let (found, exact) = (homography * (point / point.z), second_from_first() * nalgebra::Point3::from(point));
        CAMERA.fx * (found.xy() / found.z - exact.coords.xy() / exact.z).norm()
    };
    points.iter().map(error).sum::<f64>() / points.len() as f64
}

/// The robust loop around the four-point solver, on a plane.
pub fn print_homography(n_seeds: u64) {
    println!("| homography | ms | mean transfer error, px | samples |\n|---|---:|---:|---:|");
    for ratio in OUTLIER_RATIOS {
        let problems: Vec<_> =
            problems(Scene::Plane, ratio, n_seeds).iter().map(|p| (p.matches(), p.points.clone())).collect();
        let (mut found, mut is_inlier) = (Vec::new(), vec![false; MATCHES]);
        let times = Times::of(0..problems.len(), |i| {
            let mut rng = Rng::new(1, i as u64, 3);
            found.extend(estimate_homography(&problems[i].0, &HOMOGRAPHY, &mut rng, &mut is_inlier));
        });
        let errors = found.iter().zip(&problems).map(|(f, p)| transfer_error_px(&f.second_from_first, &p.1));
        println!(
            "| {MATCHES} matches, {:.0} % outliers, {} problems | {} | {:.3} | {:.0} |",
            100.0 * ratio,
            found.len(),
            times.text(),
            median(errors.collect()),
            median(found.iter().map(|estimate| estimate.n_trials as f64).collect())
        );
    }
    println!();
}

/// Landmarks of a pose without a start.
const N_EPNP: usize = 100;

/// A landmark as a place in the reference camera's axes, and where it is seen.
fn as_point(m: &LandmarkMatch) -> (Vector3<f64>, Vector2<f64>) {
    (m.reference_z1.push(1.0) / m.inverse_depth, m.seen_z1)
}

/// The robust loop around P3P, without a prediction.
pub fn print_pnp(n_seeds: u64) {
    println!(
        "| pose from landmarks | ms | rotation error, deg | position error, m | samples |\n|---|---:|---:|---:|---:|"
    );
    let few: Vec<Vec<_>> = (0..n_seeds)
        .map(|seed| TwoViews::new(Scene::Space, N_EPNP, 0.0, seed).landmark_matches().iter().map(as_point).collect())
        .collect();
    let mut found = Vec::new();
    let times = Times::of(0..few.len(), |i| found.extend(epnp(few[i].iter().copied())));
    let truth = second_from_first();
    println!(
        "| EPnP, {N_EPNP} landmarks, no outliers, {} problems | {} | {:.4} | {:.4} | - |",
        found.len(),
        times.text(),
        median(found.iter().map(|pose| pose.rotation.angle_to(&truth.rotation).to_degrees()).collect()),
        median(found.iter().map(|pose| (pose.inverse() * truth).translation.vector.norm()).collect())
    );
    for ratio in OUTLIER_RATIOS {
        let problems: Vec<_> = problems(Scene::Space, ratio, n_seeds).iter().map(TwoViews::landmark_matches).collect();
        let (mut found, mut is_inlier) = (Vec::new(), vec![false; MATCHES]);
        let times = Times::of(0..problems.len(), |i| {
            let mut rng = Rng::new(1, i as u64, 2);
            found.extend(estimate_pnp(&problems[i], &Rigid::identity(), &PNP, &mut rng, &mut is_inlier));
        });
        let errors = |of: &dyn Fn(&Rigid) -> f64| {
            median(found.iter().map(|estimate| of(&estimate.refined.camera_from_reference)).collect())
        };
        let truth = second_from_first();
        println!(
            "| {MATCHES} landmarks, {:.0} % outliers, {} problems | {} | {:.4} | {:.4} | {:.0} |",
            100.0 * ratio,
            found.len(),
            times.text(),
            errors(&rotation_error_deg),
            errors(&|pose| (pose.translation.vector - truth.translation.vector).norm()),
            median(found.iter().map(|estimate| estimate.n_trials as f64).collect())
        );
    }
    println!();
}

/// The adjustment of a full window.
pub fn print_bundle(rounds: usize) {
    println!("| bundle adjustment | ms | worst position error before, m | after, m |\n|---|---:|---:|---:|");
    let problems: Vec<_> = (0..rounds).map(|seed| window(LANDMARKS, seed as u64)).collect();
    let worst = |window: &kilogs_core::keyframe::KeyframeWindow| {
        let center = |pose: Rigid| pose.inverse().translation.vector;
        let error = |i: usize| {
            window.at(i).map_or(f64::NAN, |k| (center(k.camera_from_world) - center(camera_of_window(i))).norm())
        };
        (0..WINDOW).map(error).fold(0.0, f64::max)
    };
    let before = median(problems.iter().map(|(window, _)| worst(window)).collect());
    let mut system = Box::new(ReducedSystem::new());
    let mut adjusted = problems;
    let times = Times::of(0..rounds, |i| {
        let (window, landmarks) = &mut adjusted[i];
        adjust(window, landmarks, None, &mut system, &BUNDLE);
    });
    let after = median(adjusted.iter().map(|(window, _)| worst(window)).collect());
    println!(
        "| {WINDOW} keyframes, {LANDMARKS} landmarks seen by all, {} steps at most | {} | {before:.4} | {after:.4} |\n",
        BUNDLE.max_iterations,
        times.text()
    );
}
