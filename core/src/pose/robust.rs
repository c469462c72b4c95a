//! The relative pose of two views among outliers.

use super::hypothesis::Hypothesis;
use super::model::search;
use super::{Match, RelativePose};
use crate::math::Rng;
use core::fmt;

/// How hard the robust search between two views tries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativeSettings {
    /// Sampson distance below which a match agrees, on the plane z = 1 (pixels over focal length). Range (0, 0.01).
    pub inlier_z1: f64,
    /// Wanted probability that at least one sample was free of outliers. Range (0, 1).
    pub confidence: f64,
    /// Fewest and most samples drawn.
    pub trials: [usize; 2],
    /// Iterations of each local optimisation, over a few dozen matches.
    pub local_iterations: usize,
}

/// A relative pose with the evidence for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativeEstimate {
    /// The motion.
    pub second_from_first: RelativePose,
    /// Matches within the inlier distance.
    pub n_inliers: usize,
    /// Inliers in front of both cameras, at whatever depth.
    pub n_in_front: usize,
    /// Samples drawn.
    pub n_trials: usize,
}

/// Fewer matches than a minimal sample, or no sample gave a motion.
///
/// Keep the prediction and ask for more corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooFewMatches {
    /// Matches that were there.
    pub found: usize,
    /// Matches that a sample needs.
    pub needed: usize,
}

impl fmt::Display for TooFewMatches {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} matches gave no motion, at least {} good ones needed", self.found, self.needed)
    }
}

impl core::error::Error for TooFewMatches {}

/// Samples needed so that with probability `confidence` one of them has inliers only:
/// `ln(1 - confidence) / ln(1 - w^n)`, `w` the inlier ratio, `n` the sample size.
///
/// # Source
/// Fischler & Bolles 1981, sec. II.B.
pub fn trials_needed(inlier_ratio: f64, sample_size: i32, confidence: f64) -> usize {
    let all_good = libm::pow(inlier_ratio.clamp(0.0, 1.0), f64::from(sample_size));
    let denominator = libm::log1p(-all_good);
    if denominator >= 0.0 {
        return usize::MAX;
    }
    // A float that does not fit saturates: "never enough".
    libm::ceil(libm::log1p(-confidence) / denominator) as usize
}

/// Sum of squared errors, each cut at `inlier2`, and how many are below it; given up where the sum exceeds `beaten`.
pub(super) fn truncated_cost(squared_errors: impl Iterator<Item = f64>, inlier2: f64, beaten: f64) -> (f64, usize) {
    let (mut cost, mut n_inliers) = (0.0, 0);
    for squared in squared_errors {
        n_inliers += usize::from(squared < inlier2);
        cost += squared.min(inlier2);
        if cost > beaten {
            break;
        }
    }
    (cost, n_inliers)
}

/// Estimates rotation and direction of the step between two views, with outliers present.
///
/// RANSAC over five-point samples with truncated-quadratic scoring, in which a match counts only if some point in front
/// of both cameras explains it; every new best is optimised locally before it competes on, and the last one more
/// thoroughly. A predicted motion competes as the first hypothesis, on equal terms.
///
/// # Inputs
/// * `matches`: any order; outliers allowed.
/// * `predicted`: a guess worth trying, e.g. constant velocity.
/// * `rng`: seeded by frame; same seed, same result.
///
/// # Output
/// The motion, and `is_inlier` (as long as `matches`) filled. The step's length is not observable.
///
/// # Errors
/// [`TooFewMatches`] below five matches, or when no sample gave a motion.
///
/// # Cost
/// O(trials * solutions * n), cut short for bad hypotheses; 14 KiB of stack.
///
/// # Source
/// Torr & Zisserman 2000 (MSAC); Chum, Matas & Kittler 2003 (LO-RANSAC). Own implementation; differs in the
/// inner samples, which are refined robustly from the motion so far instead of being solved anew.
pub fn estimate_relative(
    matches: &[Match],
    predicted: Option<&RelativePose>,
    settings: &RelativeSettings,
    rng: &mut Rng,
    is_inlier: &mut [bool],
) -> Result<RelativeEstimate, TooFewMatches> {
    let start = predicted.map(Hypothesis::of);
    let (found, n_trials) = search(matches, start, settings, rng, is_inlier)?;
    let inliers = || matches.iter().zip(is_inlier.iter()).filter(|&(_, &is)| is);
    Ok(RelativeEstimate {
        second_from_first: found.pose,
        n_inliers: inliers().count(),
        n_in_front: inliers().filter(|(m, _)| found.pose.in_front_of_both(m)).count(),
        n_trials,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector2, Vector3};
    use std::vec::Vec;

    const SETTINGS: RelativeSettings =
        RelativeSettings { inlier_z1: 1e-3, confidence: 0.999, trials: [5, 2000], local_iterations: 8 };

    fn truth() -> RelativePose {
        RelativePose {
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.15, 0.0)),
            direction: Vector3::new(0.1, 0.0, -1.0).normalize(),
        }
    }

    fn scene(n: usize, outlier_ratio: f64) -> Vec<Match> {
        let (mut rng, truth) = (Rng::new(3, 0, 0), truth());
        (0..n)
            .map(|i| {
                let z = 5.0 + 25.0 * rng.unit_f64();
                let p = Vector3::new((rng.unit_f64() - 0.5) * 1.4 * z, (rng.unit_f64() - 0.5) * 0.5 * z, z);
                let q = truth.rotation * p + truth.direction;
                let mut m = Match { first_z1: (p / p.z).xy(), second_z1: (q / q.z).xy() };
                m.second_z1.x += 4e-4 * (rng.unit_f64() - 0.5);
                m.second_z1.y += 4e-4 * (rng.unit_f64() - 0.5);
                if (i as f64) < outlier_ratio * n as f64 {
                    m.second_z1.y += 0.2 * (rng.unit_f64() - 0.5);
                    m.second_z1.x += 0.2 * (rng.unit_f64() - 0.5);
                }
                m
            })
            .collect()
    }

    fn check(outlier_ratio: f64, predicted: Option<&RelativePose>) {
        let matches = scene(300, outlier_ratio);
        let mut is_inlier = [false; 300];
        let mut rng = Rng::new(1, 2, 3);
        let found =
            estimate_relative(&matches, predicted, &SETTINGS, &mut rng, &mut is_inlier).expect("enough matches");
        assert!(found.second_from_first.rotation.angle_to(&truth().rotation) < 5e-4);
        assert!((found.second_from_first.direction - truth().direction).norm() < 0.01);
        assert!(found.n_inliers >= 300 - (300.0 * outlier_ratio) as usize - 3, "{found:?}");
        assert_eq!(found.n_inliers, is_inlier.iter().filter(|&&i| i).count());
    }

    #[test]
    fn the_motion_survives_outliers() {
        check(0.0, None);
        check(0.3, None);
        check(0.5, None);
    }

    /// Forward motion with the epipole in the image, noise of half the inlier distance per axis, and an outlier in
    /// three of five matches that reaches across the image.
    fn noisy_scene(seed: u64) -> Vec<Match> {
        let (mut rng, truth) = (Rng::new(seed, 0, 0), truth());
        let mut within = |half: f64| half * (2.0 * rng.unit_f64() - 1.0);
        (0..1000)
            .map(|i| {
                let z = 25.0 + within(20.0);
                let p = Vector3::new(within(0.8) * z, within(0.25) * z, z);
                let q = truth.rotation * p + truth.direction;
                let second = if i % 5 < 3 { Vector2::new(within(0.8), within(0.25)) } else { (q / q.z).xy() };
                // The sum of three uniform numbers from -s to s has the deviation s.
                let mut noisy = |v: Vector2<f64>| v.map(|x| x + (0..3).map(|_| within(5e-4)).sum::<f64>());
                Match { first_z1: noisy((p / p.z).xy()), second_z1: noisy(second) }
            })
            .collect()
    }

    #[test]
    fn outliers_cost_little_accuracy() {
        let mut errors: Vec<f64> = (0..20)
            .map(|seed| {
                let mut rng = Rng::new(seed, 2, 3);
                let found = estimate_relative(&noisy_scene(seed), None, &SETTINGS, &mut rng, &mut [false; 1000]);
                found.expect("enough matches").second_from_first.direction.angle(&truth().direction)
            })
            .collect();
        errors.sort_by(f64::total_cmp);
        assert!(errors[10] < 2.7e-3, "median {:.4}, worst {:.4}", errors[10], errors[19]);
    }

    #[test]
    fn a_wrong_prediction_does_not_win() {
        let wrong = RelativePose { rotation: UnitQuaternion::identity(), direction: Vector3::x() };
        check(0.3, Some(&wrong));
    }

    #[test]
    fn fewer_than_five_matches_are_an_error() {
        let error = estimate_relative(&scene(4, 0.0), None, &SETTINGS, &mut Rng::new(0, 0, 0), &mut [false; 4]);
        assert_eq!(error, Err(TooFewMatches { found: 4, needed: 5 }));
    }

    #[test]
    fn the_stopping_rule_matches_hand_computed_counts() {
        for (ratio, expected) in [(1.0, 0), (0.5, 146), (0.9, 6), (0.0, usize::MAX)] {
            assert_eq!(trials_needed(ratio, 5, 0.99), expected, "inlier ratio {ratio}");
        }
    }
}
