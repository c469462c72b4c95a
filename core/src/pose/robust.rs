//! The robust loop around the five-point solver.

use super::five_point::{SAMPLE_SIZE, five_point};
use super::{Match, RelativePose, decompose_essential, essential_of, refine_relative, sampson_distance};
use crate::math::Rng;
use core::fmt;
use nalgebra::Matrix3;

/// How hard the robust loop tries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativeSettings {
    /// Sampson distance below which a match agrees, on the plane z = 1 (pixels over focal length). Range (0, 0.01).
    pub inlier_z1: f64,
    /// Wanted probability that at least one sample was free of outliers. Range (0, 1).
    pub confidence: f64,
    /// Fewest and most samples drawn.
    pub trials: [usize; 2],
    /// Iterations of each local optimisation.
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
        write!(f, "{} matches gave no relative pose, at least {} good ones needed", self.found, self.needed)
    }
}

impl core::error::Error for TooFewMatches {}

/// The kernel's scale in the local optimisation, as a fraction of the inlier distance.
const KERNEL_RATIO: f64 = 0.5;
/// Cutoffs of successive local optimisations, in inlier distances: wide first, to gather support.
const LOCAL_CUTOFFS: [f64; 2] = [3.0, 1.0];

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

/// Truncated squared distances (MSAC) and the inlier count.
fn score(essential: &Matrix3<f64>, matches: &[Match], inlier2: f64) -> (f64, usize) {
    let (mut cost, mut n_inliers) = (0.0, 0);
    for m in matches {
        let r = sampson_distance(essential, m);
        n_inliers += usize::from(r * r < inlier2);
        cost += (r * r).min(inlier2);
    }
    (cost, n_inliers)
}

/// Matches that a hypothesis is tried on before it is scored on all; the power of two of a byte.
const PROBES: usize = 256;
/// Probes between two looks at the sum.
const PROBES_PER_LOOK: usize = 16;
/// Standard deviations by which a hypothesis has to look worse than the best to be given up.
const GIVE_UP_SIGMAS: f64 = 3.0;

/// Whether a hypothesis may cost less than `to_beat`, told from few matches spread over all: one that does costs that
/// share of it on average, and a cost between 0 and `inlier2` deviates by half of `inlier2` at most (Popoviciu 1935).
///
/// # Source
/// The idea of Matas & Chum 2005, "Randomized RANSAC with sequential probability ratio test"; own test.
fn may_beat(to_beat: f64, essential: &Matrix3<f64>, matches: &[Match], inlier2: f64) -> bool {
    if matches.len() < PROBES || to_beat.is_infinite() {
        return true;
    }
    let share = to_beat / matches.len() as f64;
    let mut cost = 0.0;
    for k in 0..PROBES {
        // Reversed bits visit everywhere early (van der Corput 1935): neighbours in the list are neighbours in the image.
        let place = usize::from((k as u8).reverse_bits()) * matches.len() / PROBES;
        let Some(m) = matches.get(place) else { continue };
        let r = sampson_distance(essential, m);
        cost += (r * r).min(inlier2);
        let n = (k + 1) as f64;
        let most = share * n + GIVE_UP_SIGMAS * 0.5 * inlier2 * libm::sqrt(n);
        if (k + 1) % PROBES_PER_LOOK == 0 && cost > most {
            return false;
        }
    }
    true
}

/// Of the four motions behind an essential matrix, the one with most inliers in front of both cameras.
fn most_in_front(essential: &Matrix3<f64>, matches: &[Match], inlier2: f64) -> Option<(RelativePose, usize)> {
    let four = decompose_essential(essential)?;
    let agrees = |m: &&Match| {
        let r = sampson_distance(essential, m);
        r * r < inlier2
    };
    four.into_iter()
        .map(|pose| (pose, matches.iter().filter(agrees).filter(|m| pose.in_front_of_both(m)).count()))
        .max_by_key(|&(_, count)| count)
}

struct Best {
    pose: RelativePose,
    cost: f64,
    n_inliers: usize,
}

/// Estimates rotation and direction of the step between two views, with outliers present.
///
/// RANSAC over five-point samples with truncated-quadratic scoring; every new best is optimised locally over
/// its support before it competes on. A predicted motion competes as the first hypothesis, on equal terms.
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
/// O(trials * solutions * n), cut short for bad hypotheses; 10 KiB of stack.
///
/// # Source
/// Torr & Zisserman 2000 (MSAC); Chum, Matas & Kittler 2003 (LO-RANSAC). Own implementation; differs in the
/// local step, which is a robust refinement instead of inner sampling.
pub fn estimate_relative(
    matches: &[Match],
    predicted: Option<&RelativePose>,
    settings: &RelativeSettings,
    rng: &mut Rng,
    is_inlier: &mut [bool],
) -> Result<RelativeEstimate, TooFewMatches> {
    let inlier2 = settings.inlier_z1 * settings.inlier_z1;
    let mut best: Option<Best> = None;
    if let Some(pose) = predicted {
        optimize_locally(pose, matches, settings, &mut best);
    }
    let mut n_trials = 0;
    let mut wanted = settings.trials[1];
    while n_trials < wanted.clamp(settings.trials[0], settings.trials[1]) {
        n_trials += 1;
        let Some(drawn) = rng.draw_distinct::<SAMPLE_SIZE>(matches.len()) else { break };
        let sample = drawn.map(|i| matches.get(i).copied().unwrap_or_default());
        for essential in five_point(&sample) {
            let to_beat = best.as_ref().map_or(f64::INFINITY, |b| b.cost);
            if !may_beat(to_beat, &essential, matches, inlier2) || score(&essential, matches, inlier2).0 >= to_beat {
                continue;
            }
            if let Some((pose, _)) = most_in_front(&essential, matches, inlier2) {
                optimize_locally(&pose, matches, settings, &mut best);
            }
        }
        if let Some(b) = &best {
            let ratio = b.n_inliers as f64 / matches.len() as f64;
            wanted = trials_needed(ratio, SAMPLE_SIZE as i32, settings.confidence);
        }
    }
    let Some(best) = best else { return Err(TooFewMatches { found: matches.len(), needed: SAMPLE_SIZE }) };
    Ok(accepted(&best.pose, matches, inlier2, n_trials, is_inlier))
}

/// Refines a hypothesis over its support and keeps it when it beats the best.
fn optimize_locally(start: &RelativePose, matches: &[Match], settings: &RelativeSettings, best: &mut Option<Best>) {
    let inlier2 = settings.inlier_z1 * settings.inlier_z1;
    let width = KERNEL_RATIO * settings.inlier_z1;
    let mut pose = *start;
    for cutoff in core::iter::once(0.0).chain(LOCAL_CUTOFFS) {
        if cutoff > 0.0 {
            let cutoff_z1 = cutoff * settings.inlier_z1;
            pose = refine_relative(matches, &pose, width, cutoff_z1, settings.local_iterations).second_from_first;
        }
        let (cost, n_inliers) = score(&essential_of(&pose), matches, inlier2);
        if cost.is_finite() && best.as_ref().is_none_or(|b| cost < b.cost) {
            *best = Some(Best { pose, cost, n_inliers });
        }
    }
}

fn accepted(
    pose: &RelativePose,
    matches: &[Match],
    inlier2: f64,
    n_trials: usize,
    is_inlier: &mut [bool],
) -> RelativeEstimate {
    let essential = essential_of(pose);
    let second_from_first = most_in_front(&essential, matches, inlier2).map_or(*pose, |(p, _)| p);
    let (mut n_inliers, mut n_in_front) = (0, 0);
    for (m, flag) in matches.iter().zip(is_inlier.iter_mut()) {
        let r = sampson_distance(&essential, m);
        *flag = r * r < inlier2;
        n_inliers += usize::from(*flag);
        n_in_front += usize::from(*flag && second_from_first.in_front_of_both(m));
    }
    RelativeEstimate { second_from_first, n_inliers, n_in_front, n_trials }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector3};
    use std::vec::Vec;

    const SETTINGS: RelativeSettings =
        RelativeSettings { inlier_z1: 1e-3, confidence: 0.999, trials: [5, 500], local_iterations: 8 };

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
