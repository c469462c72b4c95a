//! Least squares by damped steps: the iteration that all refinements here share.

use super::Stop;
use nalgebra::{SMatrix, SVector};

const DAMPING_FACTOR: f64 = 10.0;
const MAX_DAMPING: f64 = 1e8;
/// Steps below this many units (radians, metres) do not change any pixel.
const NEGLIGIBLE_STEP: f64 = 1e-8;

/// A cost over `N` increments of a `State`.
pub(super) trait Descent<const N: usize> {
    type State: Copy;

    /// The cost to lower.
    fn cost(&self, at: &Self::State) -> f64;
    /// Approximate Hessian and gradient of half the cost by the increments.
    fn normal_equations(&self, at: &Self::State) -> (SMatrix<f64, N, N>, SVector<f64, N>);
    /// The state after an increment.
    fn moved(&self, from: &Self::State, step: &SVector<f64, N>) -> Self::State;

    /// The state of lowest cost on the way, its cost, and why the iteration ended.
    ///
    /// # Source
    /// Levenberg-Marquardt: Madsen, Nielsen & Tingleff 2004, sec. 3.2, with Marquardt's scaling and a fixed factor.
    fn descend(&self, start: &Self::State, first_damping: f64, max_iterations: usize) -> (Self::State, f64, Stop) {
        let mut best = *start;
        let mut cost = self.cost(&best);
        let mut damping = first_damping;
        for _ in 0..max_iterations {
            let (hessian, gradient) = self.normal_equations(&best);
            loop {
                let mut damped = hessian;
                for k in 0..N {
                    damped[(k, k)] += damping * hessian[(k, k)];
                }
                let Some(step) = damped.cholesky().map(|c| -c.solve(&gradient)) else {
                    return (best, cost, Stop::Stalled);
                };
                let is_negligible = step.norm() < NEGLIGIBLE_STEP;
                let candidate = self.moved(&best, &step);
                let candidate_cost = self.cost(&candidate);
                if candidate_cost <= cost {
                    (best, cost) = (candidate, candidate_cost);
                    damping = (damping / DAMPING_FACTOR).max(f64::EPSILON);
                    if is_negligible {
                        return (best, cost, Stop::Converged);
                    }
                    break;
                }
                damping *= DAMPING_FACTOR;
                if damping > MAX_DAMPING {
                    return (best, cost, Stop::Stalled);
                }
                if is_negligible {
                    return (best, cost, Stop::Converged);
                }
            }
        }
        (best, cost, Stop::StepLimit)
    }
}
