//! Whether a view really shows the place of an earlier keyframe, and how the two cameras stand to each other.
//!
//! 1. Points of both are matched by their descriptors, mutually and against the next best.
//! 2. An essential matrix explains where they are in both images.
//! 3. A similarity explains where they are in space: both keyframes know depths, from different drives past the points.
//!
//! A false loop bends the whole map and a missed one costs nothing, so each step has a bar, and both solvers have to agree.

use super::view::PlaceView;
use crate::camera::Pinhole;
use crate::conventions::Similarity;
use crate::features::hamming::{HammingSettings, match_mutually};
use crate::features::{Feature, FeatureMatch, Nearest, SimdLevel};
use crate::math::Rng;
use crate::math::sim3::Matrix7;
use crate::pose::{
    Match, PointMatch, PointSighting, RelativeSettings, SimilaritySettings, estimate_relative, estimate_similarity,
};
use nalgebra::Vector2;

/// Bars of [`verify_loop`].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VerificationSettings {
    /// Which descriptors match.
    pub hamming: HammingSettings,
    /// Standard deviation of a match, px: corners of two drives are up to a pixel apart. Range (0, 10); ours.
    pub noise_px: f64,
    /// Matches agree with a solver up to this many standard deviations. Range [2, 5].
    pub inlier_sigmas: f64,
    /// Matches that have to agree with each solver. ORB-SLAM and VINS ask for about 30.
    pub min_inliers: usize,
    /// Share of the matches that have to agree with the essential matrix, and of those the share that has to agree with
    /// the similarity. Range [0, 1]; ours: chance finds a share that falls with the number of matches.
    pub min_inlier_ratio: f64,
    /// Standard deviation of the inliers' places in the image, share of its width: one facade, or one car, is no place.
    /// Range [0, 0.5]; ours.
    pub min_spread: f64,
    /// Angle between the rotations that the two solvers find, rad. Ours: a wrong similarity is off by tens of degrees.
    pub max_disagreement_rad: f64,
    /// Factor by which the scales of the two drives may differ. Above 1; ours: what tracking loses on some kilometres.
    pub max_scale: f64,
    /// Distance of the two cameras, m. Ours: farther away the same points look different.
    pub max_distance_m: f64,
}

impl VerificationSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        hamming: HammingSettings { max_distance: 64, max_ratio: 0.85, same_px: 6.0 },
        noise_px: 1.0,
        inlier_sigmas: 3.0,
        min_inliers: 30,
        min_inlier_ratio: 0.5,
        min_spread: 0.08,
        max_disagreement_rad: 0.05,
        max_scale: 2.0,
        max_distance_m: 15.0,
    };
}

/// Memory of [`verify_loop`].
#[derive(Debug)]
pub struct LoopScratch<'m> {
    /// As long as the points of both views together.
    pub nearest: &'m mut [Nearest],
    /// The rest bounds how many matches are looked at; the points of one view are enough.
    pub pairs: &'m mut [FeatureMatch],
    /// As long as `pairs`.
    pub matches: &'m mut [Match],
    /// As long as `pairs`.
    pub point_matches: &'m mut [PointMatch],
    /// As long as `pairs`.
    pub is_inlier: &'m mut [bool],
}

/// Bytes of a [`LoopScratch`] per point of a view.
pub const fn bytes_per_point() -> usize {
    2 * size_of::<Nearest>() + size_of::<FeatureMatch>() + size_of::<Match>() + size_of::<PointMatch>() + 1
}

/// Why a candidate is a loop, or why not; the numbers stand beside it in [`LoopEvidence`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LoopVerdict {
    /// Every bar was taken.
    Accepted,
    /// Too few points look alike.
    TooFewMatches,
    /// Too few matches lie where one motion puts them.
    TooFewEpipolar,
    /// Too few matches lie where one similarity puts them.
    TooFewInliers,
    /// All inliers are in one part of the image.
    OnePatch,
    /// The two solvers found different rotations.
    SolversDisagree,
    /// The scale would have changed by too much.
    ScaleOff,
    /// The cameras would be too far apart to have seen the same.
    TooFarApart,
}

/// What decided about a candidate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoopEvidence {
    /// The decision.
    pub verdict: LoopVerdict,
    /// Points that look most like each other.
    pub n_matches: usize,
    /// Those that agree with the essential matrix.
    pub n_epipolar: usize,
    /// Those of them that agree with the similarity.
    pub n_inliers: usize,
    /// Their standard deviation in the image, share of its width; NaN before there are any.
    pub spread: f64,
    /// Angle between the rotations of both solvers, rad; NaN before there are two.
    pub disagreement_rad: f64,
    /// Metres of the earlier drive per metre of this one; NaN when unknown.
    pub scale: f64,
    /// Distance of the cameras, in metres of the earlier drive; NaN when unknown.
    pub distance_m: f64,
}

/// How the camera of a view stands to that of an earlier keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VerifiedLoop {
    /// From the view's camera, in its drive's metres, to the earlier one's.
    pub earlier_from_view: Similarity,
    /// Information of its left increment `[omega, upsilon, sigma]`.
    pub information: Matrix7,
}

/// Measures a view against an earlier keyframe of the same camera.
///
/// # Inputs
/// * `rng`: seeded by keyframe; same seed, same result.
///
/// # Output
/// The similarity if every bar was taken, and the numbers that decided in any case.
///
/// # Cost
/// O(points² + trials * matches); 14 KiB of stack; no allocation.
pub fn verify_loop(
    simd: SimdLevel,
    camera: &Pinhole,
    view: &PlaceView<'_>,
    earlier: &PlaceView<'_>,
    settings: &VerificationSettings,
    rng: &mut Rng,
    scratch: &mut LoopScratch<'_>,
) -> (Option<VerifiedLoop>, LoopEvidence) {
    let n = match_mutually(simd, view.features, earlier.features, &settings.hamming, scratch.nearest, scratch.pairs);
    let n_matches = keep_one_each(scratch.pairs.get_mut(..n).unwrap_or(&mut []), view.features);
    let mut evidence = LoopEvidence {
        verdict: LoopVerdict::TooFewMatches,
        n_matches,
        n_epipolar: 0,
        n_inliers: 0,
        spread: f64::NAN,
        disagreement_rad: f64::NAN,
        scale: f64::NAN,
        distance_m: f64::NAN,
    };
    let found = measure(camera, [view, earlier], settings, rng, scratch, &mut evidence);
    if found.is_some() {
        evidence.verdict = LoopVerdict::Accepted;
    }
    (found, evidence)
}

/// A point is described in several sizes and counts once: with its best match. Matches of one point stand together.
fn keep_one_each(pairs: &mut [FeatureMatch], features: &[Feature]) -> usize {
    let pixel = |m: &FeatureMatch| features.get(m.first as usize).map(|f| f.pixel);
    let mut n = 0_usize;
    for i in 0..pairs.len() {
        let next = pairs[i];
        match n.checked_sub(1) {
            Some(last) if pixel(&pairs[last]) == pixel(&next) => {
                if next.distance < pairs[last].distance {
                    pairs[last] = next;
                }
            }
            _ => {
                pairs[n] = next;
                n += 1;
            }
        }
    }
    n
}

/// Steps 2 and 3; writes the first bar that is not taken into `evidence`.
fn measure(
    camera: &Pinhole,
    [view, earlier]: [&PlaceView<'_>; 2],
    settings: &VerificationSettings,
    rng: &mut Rng,
    scratch: &mut LoopScratch<'_>,
    evidence: &mut LoopEvidence,
) -> Option<VerifiedLoop> {
    let n = evidence.n_matches;
    if n < settings.min_inliers {
        return None;
    }
    let pairs = scratch.pairs.get_mut(..n)?;
    let matches = scratch.matches.get_mut(..n)?;
    let is_inlier = scratch.is_inlier.get_mut(..n)?;
    for (m, pair) in matches.iter_mut().zip(pairs.iter()) {
        m.first_z1 = sighting(camera, view, pair.first)?.seen_z1;
        m.second_z1 = sighting(camera, earlier, pair.second)?.seen_z1;
    }
    evidence.verdict = LoopVerdict::TooFewEpipolar;
    let relative = estimate_relative(matches, None, &settings.relative(camera), rng, is_inlier).ok()?;
    evidence.n_epipolar = relative.n_inliers;
    let is_enough =
        |n: usize, of: usize| n >= settings.min_inliers && n as f64 >= settings.min_inlier_ratio * of as f64;
    if !is_enough(evidence.n_epipolar, n) {
        return None;
    }
    let mut n_points = 0;
    for (pair, _) in pairs.iter().zip(is_inlier.iter()).filter(|&(_, &is)| is) {
        let (first, second) = (sighting(camera, view, pair.first)?, sighting(camera, earlier, pair.second)?);
        *scratch.point_matches.get_mut(n_points)? = PointMatch { first, second };
        n_points += 1;
    }
    evidence.verdict = LoopVerdict::TooFewInliers;
    let points = scratch.point_matches.get(..n_points)?;
    let is_inlier = is_inlier.get_mut(..n_points)?;
    let similar = estimate_similarity(points, &settings.similarity(camera), rng, is_inlier).ok()?.refined;
    let inliers = || points.iter().zip(is_inlier.iter()).filter(|&(_, &is)| is).map(|(m, _)| m.first.seen_z1);
    evidence.n_inliers = inliers().count();
    let earlier_from_view = similar.second_from_first;
    evidence.spread = spread(inliers()) * camera.fx / f64::from(camera.width);
    evidence.disagreement_rad = earlier_from_view.isometry.rotation.angle_to(&relative.second_from_first.rotation);
    evidence.scale = earlier_from_view.scaling();
    evidence.distance_m = earlier_from_view.isometry.translation.vector.norm();
    evidence.verdict = first_bar(evidence, is_enough(evidence.n_inliers, n_points), settings)?;
    (evidence.verdict == LoopVerdict::Accepted)
        .then_some(VerifiedLoop { earlier_from_view, information: similar.information })
}

/// The first bar that a similarity does not take; bars are written so that NaN takes none.
fn first_bar(evidence: &LoopEvidence, is_enough: bool, settings: &VerificationSettings) -> Option<LoopVerdict> {
    let scales = 1.0 / settings.max_scale..=settings.max_scale;
    let bars = [
        (is_enough, LoopVerdict::TooFewInliers),
        (evidence.spread >= settings.min_spread, LoopVerdict::OnePatch),
        (evidence.disagreement_rad <= settings.max_disagreement_rad, LoopVerdict::SolversDisagree),
        (scales.contains(&evidence.scale), LoopVerdict::ScaleOff),
        (evidence.distance_m <= settings.max_distance_m, LoopVerdict::TooFarApart),
        (false, LoopVerdict::Accepted),
    ];
    bars.into_iter().find(|(is_taken, _)| !is_taken).map(|(_, verdict)| verdict)
}

fn sighting(camera: &Pinhole, view: &PlaceView<'_>, index: u32) -> Option<PointSighting> {
    let (feature, depth) = (view.features.get(index as usize)?, view.depths.get(index as usize)?);
    let inverse_depth = 1.0 / f64::from(depth.depth_m);
    Some(PointSighting {
        seen_z1: camera.unproject_z1(&Vector2::new(f64::from(feature.pixel[0]), f64::from(feature.pixel[1]))),
        inverse_depth,
        inverse_depth_sigma: inverse_depth * f64::from(depth.relative_sigma),
    })
}

/// Standard deviation of the horizontal places.
fn spread(places: impl Iterator<Item = Vector2<f64>>) -> f64 {
    let (n, sum, sum2) = places.fold((0.0, 0.0, 0.0), |(n, sum, sum2), p| (n + 1.0, sum + p.x, sum2 + p.x * p.x));
    libm::sqrt((sum2 / n - (sum / n) * (sum / n)).max(0.0))
}

impl VerificationSettings {
    fn relative(&self, camera: &Pinhole) -> RelativeSettings {
        RelativeSettings {
            inlier_z1: self.inlier_sigmas * self.noise_px / camera.fx,
            confidence: CONFIDENCE,
            trials: [FEWEST_TRIALS, MOST_TRIALS],
            local_iterations: ITERATIONS,
        }
    }

    fn similarity(&self, camera: &Pinhole) -> SimilaritySettings {
        SimilaritySettings {
            noise_z1: self.noise_px / camera.fx,
            inlier_sigmas: self.inlier_sigmas,
            confidence: CONFIDENCE,
            trials: [FEWEST_TRIALS, MOST_TRIALS],
            iterations: ITERATIONS,
        }
    }
}

/// Of having drawn a sample without outliers.
const CONFIDENCE: f64 = 0.999;
/// Samples that are drawn at least and at most: half of five matches are right in one of 32.
const FEWEST_TRIALS: usize = 50;
const MOST_TRIALS: usize = 500;
/// Iterations of a refinement.
const ITERATIONS: usize = 10;

#[cfg(test)]
mod tests;
