//! Two visits to a place, with noise, lies, and shapes that determine nothing.

use super::*;
use crate::math::sim3::{self, Tangent7};
use nalgebra::Point3;
use std::vec::Vec;

const NOISE_Z1: f64 = 1e-3;
const SETTINGS: SimilaritySettings =
    SimilaritySettings { noise_z1: NOISE_Z1, inlier_sigmas: 4.0, confidence: 0.999, trials: [10, 500], iterations: 15 };

fn gauss(rng: &mut Rng) -> f64 {
    (0..12).map(|_| rng.unit_f64() - 0.5).sum()
}

/// Two cameras at a street: `depth_sigma` of the logarithm of each depth; every lie points anywhere.
fn scene(truth: &Similarity, n: usize, depth_sigma: f64, n_lies: usize) -> Vec<PointMatch> {
    let mut rng = Rng::new(9, n as u64, 0);
    let mut matches = Vec::new();
    while matches.len() < n {
        let z = 4.0 + 30.0 * rng.unit_f64();
        let p = Point3::new((rng.unit_f64() - 0.5) * 1.4 * z, (rng.unit_f64() - 0.5) * 0.5 * z, z);
        let q = truth * p;
        let mut sighting = |p: Point3<f64>, noise: f64| PointSighting {
            seen_z1: Vector2::new(p.x / p.z + noise * gauss(&mut rng), p.y / p.z + noise * gauss(&mut rng)),
            inverse_depth: (-depth_sigma * gauss(&mut rng)).exp() / p.z,
            inverse_depth_sigma: depth_sigma.max(1e-3) / p.z,
        };
        if q.z > 1.0 {
            let mut m = PointMatch { first: sighting(p, NOISE_Z1), second: sighting(q, NOISE_Z1) };
            if matches.len() < n_lies {
                m.second = sighting(Point3::new(0.0, 0.0, 10.0), 0.2);
            }
            matches.push(m);
        }
    }
    matches
}

#[test]
fn the_similarity_is_found_among_noise_and_lies() {
    let check = |tangent: [f64; 7], n: usize, depth_sigma: f64, lie_share: f64| {
        let truth = sim3::exp(&Tangent7::from(tangent));
        let n_lies = (lie_share * n as f64) as usize;
        let matches = scene(&truth, n, depth_sigma, n_lies);
        let mut is_inlier = std::vec![false; n];
        let found = estimate_similarity(&matches, &SETTINGS, &mut Rng::new(1, 2, 3), &mut is_inlier).expect("a place");
        let off = sim3::log(&(found.refined.second_from_first * truth.inverse()));
        // The truth lies within what the information says: 7 degrees of freedom, 24 with 99.9 %.
        let squared = off.dot(&(found.refined.information * off));
        assert!(squared < 30.0, "{squared} {off} after {} trials", found.n_trials);
        let right = sim3::log(&(truth.inverse() * found.refined.second_from_first));
        let by_right = right.dot(&(found.refined.right_information() * right));
        assert!((by_right - squared).abs() < 1e-3 + 0.05 * squared, "{by_right} {squared}");
        let n_true = is_inlier[n_lies..].iter().filter(|&&i| i).count();
        let n_false = is_inlier[..n_lies].iter().filter(|&&i| i).count();
        assert!(n_true as f64 > 0.95 * (n - n_lies) as f64 && n_false <= 1 + n_lies / 50, "{n_true} {n_false}");
        assert!(found.refined.n_inliers == n_true + n_false);
        let sigma = |k: usize| found.refined.information.try_inverse().expect("regular")[(k, k)].sqrt();
        assert!(sigma(6) < 1e-2 + 2.0 * depth_sigma / (n as f64).sqrt(), "scale {}", sigma(6));
    };
    let (same, beside) = ([0.0; 7], [0.02, 0.3, 0.0, 1.0, 0.1, -3.0, 0.2]);
    check(same, 50, 0.0, 0.0);
    check(beside, 200, 0.0, 0.0);
    check(beside, 200, 0.05, 0.0);
    check(beside, 200, 0.05, 0.3);
    check(beside, 300, 0.1, 0.6);
    check([0.0, 0.0, 0.0, 0.3, 0.0, 0.0, -0.4], 200, 0.1, 0.5);
    check([0.1, 1.0, 0.05, -12.0, 0.1, 12.0, 0.05], 200, 0.05, 0.3);
}

#[test]
fn the_same_seed_gives_the_same_similarity() {
    let truth = sim3::exp(&Tangent7::from([0.02, 0.3, 0.0, 1.0, 0.1, -3.0, 0.2]));
    let matches = scene(&truth, 100, 0.05, 40);
    let run = || estimate_similarity(&matches, &SETTINGS, &mut Rng::new(1, 2, 3), &mut [false; 100]);
    assert_eq!(run(), run());
}

#[test]
fn what_determines_nothing_is_a_value() {
    let check = |points: &[[f64; 3]], usable: usize| {
        let sighting = |&[x, y, z]: &[f64; 3]| PointSighting {
            seen_z1: Vector2::new(x / z, y / z),
            inverse_depth: 1.0 / z,
            inverse_depth_sigma: 0.01 / z,
        };
        let matches: Vec<PointMatch> =
            points.iter().map(|p| PointMatch { first: sighting(p), second: sighting(p) }).collect();
        let found = estimate_similarity(&matches, &SETTINGS, &mut Rng::new(1, 2, 3), &mut [false; 8]);
        assert_eq!(found, Err(NoSimilarity { usable }), "{points:?}");
    };
    check(&[], 0);
    check(&[[0.0, 0.0, 5.0], [1.0, 0.0, 5.0]], 2);
    check(&[[0.0, 0.0, 5.0], [1.0, 0.0, 6.0], [2.0, 0.0, 7.0], [4.0, 0.0, 9.0]], 4);
    check(&[[1.0, 2.0, 5.0]; 5], 5);
    check(&[[f64::NAN, 0.0, 5.0], [1.0, 0.0, f64::NAN], [0.0, f64::INFINITY, 7.0], [0.0, 1.0, 9.0]], 1);
    check(&[[0.0, 0.0, -5.0], [1.0, 0.0, -6.0], [0.0, 1.0, -7.0]], 0);
}

#[test]
fn nan_among_good_matches_disturbs_nothing() {
    let truth = sim3::exp(&Tangent7::from([0.02, 0.3, 0.0, 1.0, 0.1, -3.0, 0.2]));
    let mut matches = scene(&truth, 100, 0.02, 0);
    matches[3].first.seen_z1.x = f64::NAN;
    matches[4].second.inverse_depth = f64::NAN;
    matches[5].second.inverse_depth_sigma = f64::NAN;
    matches[6].first.inverse_depth = 0.0;
    let mut is_inlier = [false; 100];
    let found = estimate_similarity(&matches, &SETTINGS, &mut Rng::new(1, 2, 3), &mut is_inlier).expect("a place");
    let off = sim3::log(&(found.refined.second_from_first * truth.inverse()));
    assert!(off.norm() < 0.05 && is_inlier[3..7] == [false; 4], "{off}");
}

#[test]
fn points_of_a_plane_are_aligned_without_a_mirror() {
    let truth = sim3::exp(&Tangent7::from([0.4, 1.3, 0.2, 1.0, 0.1, -3.0, 0.7]));
    let plane = [[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 2.0, 5.0], [3.0, 2.0, 5.0]].map(Vector3::from);
    let pairs = plane.map(|p| (p, (truth * Point3::from(p)).coords));
    let off = sim3::log(&(align_similarity(pairs.into_iter()).expect("spread out") * truth.inverse()));
    assert!(off.norm() < 1e-9, "{off}");
    let mirrored = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 3.0]].map(Vector3::from);
    let found = align_similarity(mirrored.iter().map(|p| (*p, Vector3::new(-p.x, p.y, p.z)))).expect("spread out");
    assert!((found.isometry.rotation.to_rotation_matrix().matrix().determinant() - 1.0).abs() < 1e-9);
}
