//! The similarity between two cameras that see the same points and know how far they are.

use super::robust::{trials_needed, truncated_cost};
use super::{SimilarityRefinement, Stop, refine_similarity};
use crate::conventions::Similarity;
use crate::math::Rng;
use core::fmt;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion, Vector2, Vector3};

/// Where a camera sees a point, and how far it takes it to be.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PointSighting {
    /// On the plane z = 1.
    pub seen_z1: Vector2<f64>,
    /// One over the depth along the camera's axis, 1/m.
    pub inverse_depth: f64,
    /// Standard deviation of that, 1/m.
    pub inverse_depth_sigma: f64,
}

/// One scene point in two cameras, each with a depth of its own.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PointMatch {
    /// In the first camera.
    pub first: PointSighting,
    /// In the second camera.
    pub second: PointSighting,
}

impl PointSighting {
    /// The point in the camera, m; `None` without a depth.
    pub fn point(&self) -> Option<Vector3<f64>> {
        let point = Vector3::new(self.seen_z1.x, self.seen_z1.y, 1.0) / self.inverse_depth;
        (self.inverse_depth > 0.0 && point.iter().all(|x| x.is_finite())).then_some(point)
    }

    /// Standard deviation of the logarithm of the depth.
    pub(super) fn log_depth_sigma(&self) -> f64 {
        self.inverse_depth_sigma / self.inverse_depth
    }
}

/// How hard the robust search tries.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimilaritySettings {
    /// Standard deviation of a sighting on the plane z = 1, per axis (pixels over focal length).
    pub noise_z1: f64,
    /// Error in standard deviations (of its three numbers together) below which a match agrees. Range 2..5.
    pub inlier_sigmas: f64,
    /// Wanted probability that at least one sample was free of outliers. Range (0, 1).
    pub confidence: f64,
    /// Fewest and most samples drawn.
    pub trials: [usize; 2],
    /// Iterations of a refinement.
    pub iterations: usize,
}

/// A similarity with the evidence for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimilarityEstimate {
    /// The refined similarity, its information and its inliers.
    pub refined: SimilarityRefinement,
    /// Samples drawn.
    pub n_trials: usize,
}

/// No three points span a similarity: too few have depths, or they lie on a line.
///
/// The two views do not show a place well enough: no loop.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoSimilarity {
    /// Matches with finite depths in both cameras.
    pub usable: usize,
}

impl fmt::Display for NoSimilarity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} matches with depths gave no similarity, 3 that are not on a line needed", self.usable)
    }
}

impl core::error::Error for NoSimilarity {}

const SAMPLE_SIZE: usize = 3;
/// Cutoffs of successive refinements, in inlier distances: wide first, to gather support.
const CUTOFFS: [f64; 2] = [3.0, 1.0];
/// A point whose logarithm of the depth is known worse than this is no basis for a sample.
const MAX_SAMPLE_UNCERTAINTY: f64 = 0.5;
/// Points are on a line when the second spread is below this share of the first.
const LINE_RATIO: f64 = 1e-4;

/// Least-squares similarity of point pairs `(in_source, in_target)`: `target_from_source`.
///
/// `None` for fewer than three pairs, points on a line, or numbers that are not finite.
///
/// # Source
/// Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns", eq. 34-43. Own
/// implementation.
pub fn align_similarity(pairs: impl Iterator<Item = (Vector3<f64>, Vector3<f64>)> + Clone) -> Option<Similarity> {
    let (n, sum_source, sum_target) =
        pairs.clone().fold((0.0, Vector3::zeros(), Vector3::zeros()), |(n, s, t), (source, target)| {
            (n + 1.0, s + source, t + target)
        });
    if n < SAMPLE_SIZE as f64 {
        return None;
    }
    let (mean_source, mean_target) = (sum_source / n, sum_target / n);
    let (mut covariance, mut variance_source) = (Matrix3::zeros(), 0.0);
    for (source, target) in pairs {
        let off = source - mean_source;
        covariance += (target - mean_target) * off.transpose();
        variance_source += off.norm_squared();
    }
    if !covariance.iter().all(|x| x.is_finite()) {
        return None;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    if svd.singular_values[1] <= LINE_RATIO * svd.singular_values[0] {
        return None;
    }
    let mirror = if u.determinant() * v_t.determinant() < 0.0 { -1.0 } else { 1.0 };
    let signs = Vector3::new(1.0, 1.0, mirror);
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let scale = svd.singular_values.dot(&signs) / variance_source;
    if !(scale.is_finite() && scale > 0.0) {
        return None;
    }
    let translation = Translation3::from(mean_target - rotation * mean_source * scale);
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    Some(Similarity::from_parts(translation, rotation, scale))
}

/// Estimates the similarity between two cameras from matches with depths in both, with outliers present.
///
/// RANSAC over three-point samples solved by [`align_similarity`]; each new best is refined by reprojection and depth
/// before it competes on.
///
/// # Inputs
/// * `matches`: any order; those without a positive, finite depth in both cameras never agree.
/// * `rng`: seeded by frame; same seed, same result.
///
/// # Output
/// The refined similarity with its information and inlier count; `is_inlier` (as long as `matches`) is filled.
///
/// # Errors
/// [`NoSimilarity`] when no sample determines one.
///
/// # Cost
/// O(trials * n), cut short for bad hypotheses; 4 KiB of stack.
///
/// # Source
/// Fischler & Bolles 1981; Torr & Zisserman 2000 (MSAC); Chum, Matas & Kittler 2003 (local optimisation).
/// Own implementation.
pub fn estimate_similarity(
    matches: &[PointMatch],
    settings: &SimilaritySettings,
    rng: &mut Rng,
    is_inlier: &mut [bool],
) -> Result<SimilarityEstimate, NoSimilarity> {
    let inlier2 = settings.inlier_sigmas * settings.inlier_sigmas;
    let mut best: Option<(Similarity, f64)> = None;
    let (mut n_trials, mut n_inliers) = (0, 0);
    let wanted = |n: usize| trials_needed(n as f64 / matches.len() as f64, SAMPLE_SIZE as i32, settings.confidence);
    while n_trials < wanted(n_inliers).clamp(settings.trials[0], settings.trials[1]) {
        n_trials += 1;
        let Some(sampled) = sample(matches, rng) else { continue };
        let to_beat = best.map_or(f64::INFINITY, |(_, cost)| cost);
        if score(&sampled, matches, settings.noise_z1, inlier2, to_beat).0 >= to_beat {
            continue;
        }
        let improved =
            CUTOFFS.iter().fold(sampled, |from, cutoff| refine(matches, &from, settings, *cutoff).second_from_first);
        let (cost, n) = score(&improved, matches, settings.noise_z1, inlier2, f64::INFINITY);
        if cost < to_beat {
            (best, n_inliers) = (Some((improved, cost)), n);
        }
    }
    let usable = || matches.iter().filter(|m| m.first.point().is_some() && m.second.point().is_some()).count();
    let Some((best, _)) = best else { return Err(NoSimilarity { usable: usable() }) };
    let mut refined = refine(matches, &best, settings, 1.0);
    for (m, flag) in matches.iter().zip(is_inlier.iter_mut()) {
        *flag = m.squared_sigmas(&refined.second_from_first, settings.noise_z1) < inlier2;
    }
    if !refined.cost.is_finite() {
        refined.stop = Stop::Stalled;
    }
    Ok(SimilarityEstimate { refined, n_trials })
}

fn sample(matches: &[PointMatch], rng: &mut Rng) -> Option<Similarity> {
    let sample = rng.draw_distinct::<SAMPLE_SIZE>(matches.len())?.map(|i| matches.get(i).copied().unwrap_or_default());
    let is_known = |s: &PointSighting| s.log_depth_sigma() <= MAX_SAMPLE_UNCERTAINTY;
    let mut pairs = [(Vector3::zeros(), Vector3::zeros()); SAMPLE_SIZE];
    for (pair, m) in pairs.iter_mut().zip(&sample) {
        if !is_known(&m.first) || !is_known(&m.second) {
            return None;
        }
        *pair = (m.first.point()?, m.second.point()?);
    }
    align_similarity(pairs.into_iter())
}

fn score(at: &Similarity, matches: &[PointMatch], noise_z1: f64, inlier2: f64, beaten: f64) -> (f64, usize) {
    truncated_cost(matches.iter().map(|m| m.squared_sigmas(at, noise_z1)), inlier2, beaten)
}

fn refine(
    matches: &[PointMatch],
    start: &Similarity,
    settings: &SimilaritySettings,
    cutoff: f64,
) -> SimilarityRefinement {
    refine_similarity(matches, start, settings.noise_z1, settings.inlier_sigmas * cutoff, settings.iterations)
}

#[cfg(test)]
mod tests;
