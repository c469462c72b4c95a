//! The robust loop, whatever the model.

use super::local::{improve, refine_fully};
use super::robust::trials_needed;
use super::{Match, RelativeSettings, TooFewMatches};
use crate::math::Rng;
use heapless::Vec;
use nalgebra::Matrix3;

/// Most solutions of a minimal sample.
pub(super) const MAX_SOLUTIONS: usize = super::polynomial::MAX_DEGREE;

/// A relation between two views that `N` matches determine.
pub(super) trait Model<const N: usize>: Copy {
    /// Matrices under which the sample's matches agree exactly.
    fn solve(sample: &[Match; N]) -> Vec<Matrix3<f64>, MAX_SOLUTIONS>;
    /// Squared distance of a match that no model behind the matrix falls below, on the plane z = 1.
    fn least_squared_distance(solution: &Matrix3<f64>, m: &Match) -> f64;
    /// The model behind one of the sample's solutions.
    fn of_solution(solution: &Matrix3<f64>, sample: &[Match; N]) -> Option<Self>;
    /// Squared distance of a match, on the plane z = 1; need be exact only below `limit2`.
    fn squared_distance(&self, m: &Match, limit2: f64) -> f64;
    /// The model that fits matches best near this one; Cauchy's kernel, constant beyond the cutoff.
    fn refined<'m>(
        &self,
        matches: impl Iterator<Item = &'m Match> + Clone,
        width_z1: f64,
        cutoff_z1: f64,
        max_iterations: usize,
    ) -> Self;
}

/// A model with its truncated squared distances (MSAC).
#[derive(Clone, Copy, Debug)]
pub(super) struct Scored<M> {
    pub model: M,
    pub cost: f64,
    pub n_inliers: usize,
}

impl<M> Scored<M> {
    pub fn of<const N: usize>(model: M, matches: &[Match], inlier2: f64) -> Self
    where
        M: Model<N>,
    {
        let (mut cost, mut n_inliers) = (0.0, 0);
        for m in matches {
            let r2 = model.squared_distance(m, inlier2);
            n_inliers += usize::from(r2 < inlier2);
            cost += r2.min(inlier2);
        }
        Self { model, cost, n_inliers }
    }
}

/// Matches that a hypothesis is tried on before it is scored on all; the power of two of a byte.
const PROBES: usize = 256;
/// Probes between two looks at the sum.
const PROBES_PER_LOOK: usize = 16;
/// Standard deviations by which a hypothesis has to look worse than the best to be given up.
const GIVE_UP_SIGMAS: f64 = 3.0;

/// Whether a solution may cost less than `to_beat`, told from few matches spread over all: one that does costs that
/// share of it on average, and a cost between 0 and `inlier2` deviates by half of `inlier2` at most (Popoviciu 1935).
///
/// # Source
/// The idea of Matas & Chum 2005, "Randomized RANSAC with sequential probability ratio test"; own test.
fn may_beat<M: Model<N>, const N: usize>(
    to_beat: f64,
    solution: &Matrix3<f64>,
    matches: &[Match],
    inlier2: f64,
) -> bool {
    if matches.len() < PROBES || to_beat.is_infinite() {
        return true;
    }
    let share = to_beat / matches.len() as f64;
    let mut cost = 0.0;
    for k in 0..PROBES {
        // Reversed bits visit everywhere early (van der Corput 1935): neighbours in the list are neighbours in the image.
        let place = usize::from((k as u8).reverse_bits()) * matches.len() / PROBES;
        let Some(m) = matches.get(place) else { continue };
        cost += M::least_squared_distance(solution, m).min(inlier2);
        let n = (k + 1) as f64;
        let most = share * n + GIVE_UP_SIGMAS * 0.5 * inlier2 * libm::sqrt(n);
        if (k + 1) % PROBES_PER_LOOK == 0 && cost > most {
            return false;
        }
    }
    true
}

/// Inner samples of a model that beats the best, and of the best in the end.
const LOCAL_SAMPLES: usize = 4;
const FINAL_SAMPLES: usize = 6;

/// The model that most matches agree on, optimised, and the samples drawn; `is_inlier` is filled.
///
/// # Source
/// Torr & Zisserman 2000 (MSAC); Chum, Matas & Kittler 2003 (LO-RANSAC). Own implementation; differs in the
/// inner samples, which are refined robustly from the model so far instead of being solved anew.
pub(super) fn search<M: Model<N>, const N: usize>(
    matches: &[Match],
    start: Option<M>,
    settings: &RelativeSettings,
    rng: &mut Rng,
    is_inlier: &mut [bool],
) -> Result<(M, usize), TooFewMatches> {
    let inlier2 = settings.inlier_z1 * settings.inlier_z1;
    let mut best: Option<Scored<M>> = None;
    if let Some(model) = start {
        let start = Scored::of(model, matches, inlier2);
        compete(&mut best, improve(start, LOCAL_SAMPLES, matches, settings, rng, is_inlier));
    }
    let mut n_trials = 0;
    let mut wanted = settings.trials[1];
    while n_trials < wanted.clamp(settings.trials[0], settings.trials[1]) {
        n_trials += 1;
        let Some(drawn) = rng.draw_distinct::<N>(matches.len()) else { break };
        let sample = drawn.map(|i| matches.get(i).copied().unwrap_or_default());
        for solution in M::solve(&sample) {
            let to_beat = best.as_ref().map_or(f64::INFINITY, |b| b.cost);
            if !may_beat::<M, N>(to_beat, &solution, matches, inlier2) {
                continue;
            }
            let Some(model) = M::of_solution(&solution, &sample) else { continue };
            let start = Scored::of(model, matches, inlier2);
            if start.cost < to_beat {
                compete(&mut best, improve(start, LOCAL_SAMPLES, matches, settings, rng, is_inlier));
            }
        }
        if let Some(b) = &best {
            let ratio = b.n_inliers as f64 / matches.len() as f64;
            wanted = trials_needed(ratio, N as i32, settings.confidence);
        }
    }
    let Some(best) = best else { return Err(TooFewMatches { found: matches.len(), needed: N }) };
    let best = improve(best, FINAL_SAMPLES, matches, settings, rng, is_inlier);
    let model = refine_fully(&best.model, matches, settings.inlier_z1, is_inlier);
    for (m, flag) in matches.iter().zip(is_inlier.iter_mut()) {
        *flag = model.squared_distance(m, inlier2) < inlier2;
    }
    Ok((model, n_trials))
}

fn compete<M>(best: &mut Option<Scored<M>>, candidate: Scored<M>) {
    if candidate.cost.is_finite() && best.as_ref().is_none_or(|b| candidate.cost < b.cost) {
        *best = Some(candidate);
    }
}
