//! One part of the chain: Levenberg-Marquardt, and which of its loops are believed.

use super::edge::{Linearized, Share, residual};
use super::factor::{add_coupling, solve};
use super::optimize::OptimizeSettings;
use super::storage::{Junction, SolverStorage};
use super::{LoopEdge, Node, renormalized};
use crate::conventions::Similarity;
use crate::math::sim3::{self, Matrix7, Tangent7};
use crate::pose::Stop;
use core::ops::RangeInclusive;

const FIRST_DAMPING: f64 = 1e-6;
const DAMPING_FACTOR: f64 = 10.0;
const MAX_DAMPING: f64 = 1e8;
/// A relative gain below this ends the iteration.
const NEGLIGIBLE_GAIN: f64 = 1e-6;
/// A cost per edge below this, in squared standard deviations, is a perfect fit.
const PERFECT: f64 = 1e-12;
/// Steps between two looks at the loops' weights while they are told apart.
const STEPS_PER_LOOK: usize = 2;
/// Growth of the control number of graduated non-convexity from look to look.
const SHARPEN: f64 = 2.0;
/// Control number at which the kernel is the truncated parabola.
const SHARP: f64 = 1e3;

/// Rejected loops that the others cannot live with, after which no more are asked.
const MAX_REFUSALS: usize = 2;

/// A part of the chain under optimisation; its first node is held.
pub(super) struct Part<'p> {
    pub(super) nodes: &'p mut [Node],
    pub(super) loops: &'p mut [LoopEdge],
    pub(super) part: RangeInclusive<usize>,
    pub(super) n_junctions: usize,
    pub(super) is_scale_free: bool,
}

impl Part<'_> {
    /// Optimises with all loops, then with fewer and fewer of those that are off; cost and outcome.
    pub(super) fn tell_apart(
        &mut self,
        settings: &OptimizeSettings,
        work: &mut SolverStorage<'_>,
        n_iterations: &mut usize,
    ) -> (f64, Stop) {
        self.loops.iter_mut().for_each(|l| (l.weight, l.is_settled, l.is_retried) = (1.0, true, false));
        let outcome = self.descend(settings.max_iterations, work, n_iterations);
        let limit = settings.max_loop_sigmas * settings.max_loop_sigmas;
        let worst = self.loops.iter().map(|l| l.squared_sigmas).fold(0.0, f64::max);
        if worst <= limit {
            return outcome;
        }
        let mut sharpness = limit / (2.0 * worst - limit);
        while sharpness < SHARP && self.reweigh(limit, sharpness) {
            self.descend(STEPS_PER_LOOK, work, n_iterations);
            sharpness *= SHARPEN;
        }
        for edge in &mut *self.loops {
            edge.weight = if edge.squared_sigmas > limit { 0.0 } else { 1.0 };
        }
        self.retry(limit, settings.max_iterations, work, n_iterations)
    }

    /// Optimises with the loops believed, then asks the rejected ones that are off the least once more, one by one: over a
    /// long way a true loop is far off until it is believed.
    fn retry(
        &mut self,
        limit: f64,
        max_iterations: usize,
        work: &mut SolverStorage<'_>,
        n_iterations: &mut usize,
    ) -> (f64, Stop) {
        let mut outcome = self.descend(max_iterations, work, n_iterations);
        let mut n_refused = 0;
        while n_refused < MAX_REFUSALS {
            let rejected = self.loops.iter_mut().filter(|l| l.weight == 0.0 && !l.is_retried);
            let Some(next) = rejected.min_by(|a, b| a.squared_sigmas.total_cmp(&b.squared_sigmas)) else { break };
            (next.weight, next.is_retried) = (1.0, true);
            let serial = next.serial;
            outcome = self.descend(max_iterations, work, n_iterations);
            if self.loops.iter().any(|l| l.weight > 0.0 && l.squared_sigmas > limit) {
                self.loops.iter_mut().filter(|l| l.serial == serial).for_each(|l| l.weight = 0.0);
                outcome = self.descend(max_iterations, work, n_iterations);
                n_refused += 1;
            }
        }
        outcome
    }

    /// Weights of the truncated parabola, softened; whether some are between 0 and 1 (Yang et al. 2020, eq. 14).
    fn reweigh(&mut self, limit: f64, sharpness: f64) -> bool {
        let mut is_undecided = false;
        for edge in &mut *self.loops {
            let off = edge.squared_sigmas;
            edge.weight = if off >= limit * (sharpness + 1.0) / sharpness {
                0.0
            } else if off <= limit * sharpness / (sharpness + 1.0) {
                1.0
            } else {
                is_undecided = true;
                libm::sqrt(limit * sharpness * (sharpness + 1.0) / off) - sharpness
            };
        }
        is_undecided
    }

    /// Levenberg-Marquardt with the loops' weights as they are.
    fn descend(
        &mut self,
        max_iterations: usize,
        work: &mut SolverStorage<'_>,
        n_iterations: &mut usize,
    ) -> (f64, Stop) {
        let perfect = PERFECT * (self.part.end() - self.part.start()) as f64;
        let mut cost = self.keep_and_cost(work);
        let mut damping = FIRST_DAMPING;
        for _ in 0..max_iterations {
            if cost <= perfect {
                return (cost, Stop::Converged);
            }
            *n_iterations += 1;
            self.linearize(damping, work);
            let is_solved = solve(&self.part, self.n_junctions, work);
            let candidate_cost = if is_solved { self.candidate_cost(work) } else { f64::INFINITY };
            if candidate_cost < cost {
                let gain = (cost - candidate_cost) / cost;
                for (node, column) in self.nodes.iter_mut().zip(&*work.columns).skip(*self.part.start()) {
                    node.world_from_node = column.candidate;
                }
                cost = candidate_cost;
                damping /= DAMPING_FACTOR;
                if gain < NEGLIGIBLE_GAIN {
                    return (cost, Stop::Converged);
                }
            } else {
                damping *= DAMPING_FACTOR;
                if damping > MAX_DAMPING {
                    return (self.keep_and_cost(work), Stop::Stalled);
                }
            }
        }
        (self.keep_and_cost(work), Stop::StepLimit)
    }

    /// Cost where the nodes are.
    pub(super) fn keep_and_cost(&mut self, work: &mut SolverStorage<'_>) -> f64 {
        for (node, column) in self.nodes.iter().zip(work.columns.iter_mut()) {
            column.candidate = node.world_from_node;
        }
        self.cost(work)
    }

    /// Cost after the step that the solver found.
    fn candidate_cost(&mut self, work: &mut SolverStorage<'_>) -> f64 {
        for k in self.part.start() + 1..=*self.part.end() {
            let column = &mut work.columns[k];
            column.candidate = renormalized(self.nodes[k].world_from_node * sim3::exp(&-column.gradient));
        }
        self.cost(work)
    }

    fn cost(&mut self, work: &SolverStorage<'_>) -> f64 {
        let squared = |r: &Tangent7, information: &Matrix7| r.dot(&(information * r));
        let mut cost = 0.0;
        for k in *self.part.start()..*self.part.end() {
            let (this, next) = (&self.nodes[k], &self.nodes[k + 1]);
            let r =
                residual(&next.node_from_previous(this), &work.columns[k].candidate, &work.columns[k + 1].candidate);
            cost += squared(&r, &next.information);
        }
        for edge in &mut *self.loops {
            let [from, to] = edge.ends.map(|k| &work.columns[k].candidate);
            edge.squared_sigmas = squared(&residual(&edge.to_from_from, from, to), &edge.information);
            cost += edge.weight * edge.squared_sigmas;
        }
        cost
    }

    /// Normal equations where the nodes are, their diagonal enlarged by `damping`.
    fn linearize(&self, damping: f64, work: &mut SolverStorage<'_>) {
        let (start, end) = (*self.part.start(), *self.part.end());
        for column in &mut work.columns[start..=end] {
            column.diagonal = Matrix7::zeros();
            column.gradient = Tangent7::zeros();
            column.to_next = Matrix7::zeros();
            if !self.is_scale_free {
                column.diagonal[(6, 6)] = 1.0;
            }
        }
        work.blocks.iter_mut().take(self.n_blocks(work.junctions)).for_each(|b| b.block = Matrix7::zeros());
        for k in start..end {
            let (this, next) = (&self.nodes[k], &self.nodes[k + 1]);
            let share = self.share(&next.node_from_previous(this), &next.information, k, k + 1);
            add(work, k, &share.ii, &share.gradient_i);
            add(work, k + 1, &share.jj, &share.gradient_j);
            work.columns[k].to_next = share.ji;
        }
        for edge in self.loops.iter().filter(|l| l.weight > 0.0) {
            let [i, j] = edge.ends;
            let share = self.share(&edge.to_from_from, &(edge.information * edge.weight), i, j);
            add(work, i, &share.ii, &share.gradient_i);
            add(work, j, &share.jj, &share.gradient_j);
            if i != start && j != start {
                add_coupling(work, j, i, &share.ji);
            }
        }
        for column in &mut work.columns[start..=end] {
            for k in 0..column.gradient.len() {
                column.diagonal[(k, k)] *= 1.0 + damping;
            }
        }
    }

    pub(super) fn n_blocks(&self, junctions: &[Junction]) -> usize {
        junctions[..self.n_junctions].last().map_or(0, |j| j.blocks[1] as usize)
    }

    fn share(&self, measured_j_from_i: &Similarity, information: &Matrix7, i: usize, j: usize) -> Share {
        let (world_from_i, world_from_j) = (&self.nodes[i].world_from_node, &self.nodes[j].world_from_node);
        let edge = Linearized::new(measured_j_from_i, world_from_i, world_from_j, self.is_scale_free);
        Share::new(&edge, information)
    }
}

fn add(work: &mut SolverStorage<'_>, node: usize, block: &Matrix7, gradient: &Tangent7) {
    work.columns[node].diagonal += block;
    work.columns[node].gradient += gradient;
}
