//! The robust loop around the three-point solver.

use super::robust::{trials_needed, truncated_cost};
use super::{LandmarkMatch, PoseRefinement, Stop, epnp, p3p, refine_pose};
use crate::conventions::Rigid;
use crate::math::Rng;
use core::fmt;
use nalgebra::{Matrix6, Vector3};

/// How hard the robust loop tries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PnpSettings {
    /// Standard deviation of a sighting on the plane z = 1, per axis (pixels over focal length).
    pub noise_z1: f64,
    /// Error in standard deviations below which a landmark agrees. Range 2..5.
    pub inlier_sigmas: f64,
    /// Wanted probability that at least one sample was free of outliers. Range (0, 1).
    pub confidence: f64,
    /// Fewest and most samples drawn.
    pub trials: [usize; 2],
    /// Iterations of a refinement.
    pub iterations: usize,
}

/// Fewer landmarks than three with a depth.
///
/// Keep the prediction; the window has lost the scene and must be started anew.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TooFewLandmarks {
    /// Landmarks that were there.
    pub found: usize,
    /// Landmarks that a sample needs.
    pub needed: usize,
}

impl fmt::Display for TooFewLandmarks {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} landmarks gave no camera pose, at least {} needed", self.found, self.needed)
    }
}

impl core::error::Error for TooFewLandmarks {}

/// A camera pose with the evidence for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PnpEstimate {
    /// The refined pose.
    pub refined: PoseRefinement,
    /// Samples drawn.
    pub n_trials: usize,
}

const SAMPLE_SIZE: usize = 3;
/// Cutoffs of successive refinements, in inlier distances: wide first, to gather support.
const CUTOFFS: [f64; 2] = [3.0, 1.0];
/// A landmark whose inverse depth is known worse than this fraction is no basis for a sample.
const MAX_SAMPLE_UNCERTAINTY: f64 = 0.5;

fn has_known_depth(m: &LandmarkMatch) -> bool {
    m.inverse_depth > 0.0 && m.inverse_depth_sigma <= MAX_SAMPLE_UNCERTAINTY * m.inverse_depth
}

/// Place in the reference camera, m.
fn reference_point(m: &LandmarkMatch) -> Vector3<f64> {
    Vector3::new(m.reference_z1.x, m.reference_z1.y, 1.0) / m.inverse_depth
}

/// Draws three landmarks whose depth is known.
fn sample_poses(matches: &[LandmarkMatch], rng: &mut Rng) -> heapless::Vec<Rigid, 4> {
    let Some(drawn) = rng.draw_distinct::<SAMPLE_SIZE>(matches.len()) else { return heapless::Vec::new() };
    let sample = drawn.map(|i| matches.get(i).copied().unwrap_or_default());
    if !sample.iter().all(has_known_depth) {
        return heapless::Vec::new();
    }
    p3p(&sample.map(|m| reference_point(&m)), &sample.map(|m| m.seen_z1))
}

/// The pose from all landmarks that agree with a sample's, where that is better: three sightings carry their noise into the
/// pose, and from far off the refinement can end beside it.
fn pose_from_agreeing(sampled: &Rigid, cost: f64, matches: &[LandmarkMatch], settings: &PnpSettings) -> Rigid {
    let inlier2 = settings.inlier_sigmas * settings.inlier_sigmas;
    let agreeing = matches
        .iter()
        .filter(|m| has_known_depth(m) && m.squared_sigmas(sampled, settings.noise_z1) < inlier2)
        .map(|m| (reference_point(m), m.seen_z1));
    let better = |pose: &Rigid| score(pose, matches, settings.noise_z1, inlier2, cost).0 < cost;
    epnp(agreeing).filter(better).unwrap_or(*sampled)
}

fn score(pose: &Rigid, matches: &[LandmarkMatch], noise_z1: f64, inlier2: f64, beaten: f64) -> (f64, usize) {
    truncated_cost(matches.iter().map(|m| m.squared_sigmas(pose, noise_z1)), inlier2, beaten)
}

/// Estimates the camera pose from landmarks, with outliers present.
///
/// The prediction competes first; P3P samples follow until the stopping rule is satisfied; the best is refined.
///
/// # Inputs
/// * `matches`: landmarks of the reference camera and where they are seen now.
/// * `predicted_camera_from_reference`: a guess worth trying, e.g. constant velocity.
/// * `rng`: seeded by frame; same seed, same result.
///
/// # Output
/// The refined pose with information and inlier count; `is_inlier` (as long as `matches`) is filled.
///
/// # Errors
/// [`TooFewLandmarks`] below three matches.
///
/// # Cost
/// O(trials * n), cut short for bad hypotheses; 4 KiB of stack.
///
/// # Source
/// Fischler & Bolles 1981; Torr & Zisserman 2000 (MSAC); Chum, Matas & Kittler 2003 (local optimisation, here by EPnP).
/// Own implementation.
pub fn estimate_pnp(
    matches: &[LandmarkMatch],
    predicted_camera_from_reference: &Rigid,
    settings: &PnpSettings,
    rng: &mut Rng,
    is_inlier: &mut [bool],
) -> Result<PnpEstimate, TooFewLandmarks> {
    if matches.len() < SAMPLE_SIZE {
        return Err(TooFewLandmarks { found: matches.len(), needed: SAMPLE_SIZE });
    }
    let inlier2 = settings.inlier_sigmas * settings.inlier_sigmas;
    let improve = |start: &Rigid| {
        CUTOFFS.iter().fold(*start, |pose, cutoff| refine(matches, &pose, settings, *cutoff).camera_from_reference)
    };
    let mut best = improve(predicted_camera_from_reference);
    let (mut cost, mut n_inliers) = score(&best, matches, settings.noise_z1, inlier2, f64::INFINITY);
    let mut n_trials = 0;
    let wanted = |n: usize| trials_needed(n as f64 / matches.len() as f64, SAMPLE_SIZE as i32, settings.confidence);
    while n_trials < wanted(n_inliers).clamp(settings.trials[0], settings.trials[1]) {
        n_trials += 1;
        for pose in sample_poses(matches, rng) {
            let (sampled_cost, _) = score(&pose, matches, settings.noise_z1, inlier2, cost);
            if sampled_cost < cost {
                let candidate = improve(&pose_from_agreeing(&pose, sampled_cost, matches, settings));
                let (candidate_cost, n) = score(&candidate, matches, settings.noise_z1, inlier2, f64::INFINITY);
                if candidate_cost < cost {
                    (best, cost, n_inliers) = (candidate, candidate_cost, n);
                }
            }
        }
    }
    let mut refined = refine(matches, &best, settings, 1.0);
    for (m, flag) in matches.iter().zip(is_inlier.iter_mut()) {
        *flag = m.squared_sigmas(&refined.camera_from_reference, settings.noise_z1) < inlier2;
    }
    if !refined.cost.is_finite() {
        refined.stop = Stop::Stalled;
    }
    Ok(PnpEstimate { refined, n_trials })
}

fn refine(matches: &[LandmarkMatch], start: &Rigid, settings: &PnpSettings, cutoff: f64) -> PoseRefinement {
    let cutoff_sigmas = settings.inlier_sigmas * cutoff;
    refine_pose(matches, start, settings.noise_z1, cutoff_sigmas, &Matrix6::zeros(), settings.iterations)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::se3;
    use nalgebra::{Point3, Vector2, Vector6};
    use std::vec::Vec;

    const SETTINGS: PnpSettings =
        PnpSettings { noise_z1: 1e-3, inlier_sigmas: 3.0, confidence: 0.999, trials: [0, 300], iterations: 15 };

    fn truth() -> Rigid {
        se3::exp(&Vector6::new(0.0, 0.1, 0.0, 0.2, 0.0, -2.0))
    }

    fn scene(outlier_every: usize) -> Vec<LandmarkMatch> {
        let mut rng = Rng::new(11, 0, 0);
        (0..150)
            .map(|i| {
                let z = 5.0 + 30.0 * rng.unit_f64();
                let p = Vector3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * 0.5 * z, z);
                let q = truth() * Point3::from(p);
                let mut noise = |amount: f64| Vector2::new(rng.unit_f64() - 0.5, rng.unit_f64() - 0.5) * amount;
                let off = if i % outlier_every == 0 { noise(0.4) } else { noise(2e-3) };
                LandmarkMatch {
                    reference_z1: (p / p.z).xy(),
                    inverse_depth: 1.0 / z,
                    inverse_depth_sigma: 0.02 / z,
                    seen_z1: (q.coords / q.z).xy() + off,
                }
            })
            .collect()
    }

    fn check(outlier_every: usize, predicted: Rigid) {
        let matches = scene(outlier_every);
        let mut is_inlier = [false; 150];
        let found =
            estimate_pnp(&matches, &predicted, &SETTINGS, &mut Rng::new(1, 1, 1), &mut is_inlier).expect("enough");
        let error = se3::log(&(found.refined.camera_from_reference * truth().inverse()));
        assert!(error.norm() < 0.03, "{error} after {} trials", found.n_trials);
        assert!(!is_inlier[0] && is_inlier[1]);
    }

    #[test]
    fn the_pose_is_found_from_far_away_and_among_outliers() {
        check(10, Rigid::identity());
        check(3, Rigid::identity());
        check(3, se3::exp(&Vector6::new(1.0, -1.0, 0.5, 20.0, 3.0, 9.0)));
    }

    #[test]
    fn all_that_agree_with_a_sample_know_better() {
        let matches = scene(3);
        let error = |pose: &Rigid| se3::log(&(*pose * truth().inverse())).norm();
        let (mut n_better, mut n_sampled) = (0, 0);
        for seed in 0..100 {
            for pose in sample_poses(&matches, &mut Rng::new(seed, 0, 0)) {
                let (cost, n_inliers) = score(&pose, &matches, SETTINGS.noise_z1, 9.0, f64::INFINITY);
                if n_inliers > 30 {
                    n_sampled += 1;
                    n_better +=
                        usize::from(error(&pose_from_agreeing(&pose, cost, &matches, &SETTINGS)) < error(&pose));
                }
            }
        }
        assert!(n_sampled > 20 && 4 * n_better > 3 * n_sampled, "{n_better} of {n_sampled}");
    }

    #[test]
    fn two_landmarks_are_an_error() {
        let error = estimate_pnp(&scene(9)[..2], &truth(), &SETTINGS, &mut Rng::new(0, 0, 0), &mut [false; 2]);
        assert_eq!(error.err(), Some(TooFewLandmarks { found: 2, needed: 3 }));
    }
}
