//! Local optimisation of a model over the matches that support it.

use super::model::{Model, Scored};
use super::{Match, RelativeSettings};
use crate::math::Rng;

/// Matches of an inner sample: enough to average their noise, few enough to be quick and to differ from the next.
const INNER_SIZE: usize = 60;
/// Kernel and cutoff over an inner sample, in inlier distances.
const INNER_WIDTH: f64 = 1.0;
const INNER_CUTOFF: f64 = 5.0;
/// Distance up to which a match supports a model, in inlier distances. Where the inlier distance is two standard
/// deviations, this is where Gaussian noise meets outliers that are uniform over an image.
const SUPPORT: f64 = 1.5;
/// Kernel over all of the support, in inlier distances: nearly least squares.
const FULL_WIDTH: f64 = 2.0;
const FULL_ITERATIONS: usize = 6;
/// Times that the support is chosen anew.
const FULL_ROUNDS: usize = 2;

/// Marks the support of a model and counts it.
fn mark_support<M: Model<N>, const N: usize>(
    model: &M,
    matches: &[Match],
    inlier_z1: f64,
    is_support: &mut [bool],
) -> usize {
    let limit2 = SUPPORT * SUPPORT * inlier_z1 * inlier_z1;
    let mut n_support = 0;
    for (m, flag) in matches.iter().zip(is_support.iter_mut()) {
        *flag = model.squared_distance(m, limit2) < limit2;
        n_support += usize::from(*flag);
    }
    n_support
}

fn supporting<'m>(matches: &'m [Match], is_support: &'m [bool]) -> impl Iterator<Item = &'m Match> + Clone {
    matches.iter().zip(is_support).filter(|&(_, &is)| is).map(|(m, _)| m)
}

/// Draws up to [`INNER_SIZE`] of `n` matches, each set equally likely, and returns how many.
///
/// # Source
/// Knuth, "The art of computer programming", vol. 2, algorithm 3.4.2 S.
fn draw<'m>(from: impl Iterator<Item = &'m Match>, n: usize, rng: &mut Rng, drawn: &mut [Match; INNER_SIZE]) -> usize {
    let mut n_drawn = 0;
    for (i, m) in from.enumerate() {
        if rng.below(n - i) < INNER_SIZE - n_drawn
            && let Some(slot) = drawn.get_mut(n_drawn)
        {
            *slot = *m;
            n_drawn += 1;
        }
    }
    n_drawn
}

/// The cheapest among a model and those that fit random parts of its support.
///
/// A refinement over all of the support stays where it starts: outliers within reach make a minimum of their own
/// beside the best one, the more so in forward motion, where the epipole lies in the image. Random parts of the
/// support have other outliers, and each new best has a cleaner support.
///
/// # Source
/// Chum, Matas & Kittler 2003, "Locally optimized RANSAC", sec. 3 (inner RANSAC). Own implementation.
pub(super) fn improve<M: Model<N>, const N: usize>(
    start: Scored<M>,
    n_samples: usize,
    matches: &[Match],
    settings: &RelativeSettings,
    rng: &mut Rng,
    is_support: &mut [bool],
) -> Scored<M> {
    let inlier_z1 = settings.inlier_z1;
    let mut best = start;
    let mut drawn = [Match::default(); INNER_SIZE];
    let mut n_support = mark_support(&best.model, matches, inlier_z1, is_support);
    for _ in 0..n_samples {
        let n_drawn = draw(supporting(matches, is_support), n_support, rng, &mut drawn);
        let sample = drawn.get(..n_drawn).unwrap_or_default();
        let (width_z1, cutoff_z1) = (INNER_WIDTH * inlier_z1, INNER_CUTOFF * inlier_z1);
        let fit = best.model.refined(sample.iter(), width_z1, cutoff_z1, settings.local_iterations);
        let candidate = Scored::of(fit, matches, inlier_z1 * inlier_z1);
        if candidate.cost < best.cost {
            best = candidate;
            n_support = mark_support(&best.model, matches, inlier_z1, is_support);
        }
    }
    best
}

/// Nearly least squares over all of the support, which is chosen anew after each fit.
///
/// # Source
/// Hartley & Zisserman 2004, algorithm 4.4, step (v). Own implementation.
pub(super) fn refine_fully<M: Model<N>, const N: usize>(
    start: &M,
    matches: &[Match],
    inlier_z1: f64,
    is_support: &mut [bool],
) -> M {
    let mut found = *start;
    for _ in 0..FULL_ROUNDS {
        mark_support(&found, matches, inlier_z1, is_support);
        let support = supporting(matches, is_support);
        found = found.refined(support, FULL_WIDTH * inlier_z1, SUPPORT * inlier_z1, FULL_ITERATIONS);
    }
    found
}
