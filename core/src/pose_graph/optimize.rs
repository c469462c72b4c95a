//! Finds the parts of the chain that loops cover, optimises them, and carries along the rest.

use super::order::order_junctions;
use super::part::Part;
use super::storage::{SolverFull, SolverStorage};
use super::{LoopEdge, PoseGraph, renormalized};
use crate::conventions::Similarity;
use crate::pose::Stop;
use core::ops::RangeInclusive;

/// What stays where it is: a graph of relative measurements says nothing about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Gauge {
    /// The first node.
    First,
    /// The newest node, so that what is tracked now does not jump.
    Newest,
    /// The node nearest to a keyframe.
    Keyframe(u32),
}

/// How much is optimised.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    /// Parts of the chain that loops pushed since the last time cover; what no new loop covers stays as it is or is carried
    /// along as a whole, which is exact.
    Changed,
    /// All parts that loops cover.
    Whole,
}

/// How the graph is optimised.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OptimizeSettings {
    /// What stays where it is.
    pub gauge: Gauge,
    /// How much is optimised.
    pub extent: Extent,
    /// Whether scales may change; else the graph is one of rigid motions.
    pub is_scale_free: bool,
    /// A loop that is further off than this many standard deviations (of all its 7 numbers together) when all agree as
    /// well as they can is false. Range 4..20; 6 keeps all but one true loop in 10^5.
    pub max_loop_sigmas: f64,
    /// Steps of Levenberg-Marquardt per part and set of loops believed. Range 5..100.
    pub max_iterations: usize,
}

/// What the optimisation did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OptimizeReport {
    /// Squared residuals in units of their variances, of all edges optimised, loops as believed before.
    pub cost_before: f64,
    /// The same after, without the loops rejected.
    pub cost_after: f64,
    /// Steps tried.
    pub n_iterations: usize,
    /// Nodes optimised; the others were carried along or stayed.
    pub n_optimized: usize,
    /// Blocks of the factor that the largest part needed.
    pub n_blocks: usize,
    /// Loops of these parts that the others contradict.
    pub n_rejected: usize,
    /// Why the last part stopped.
    pub stop: Stop,
}

impl PoseGraph<'_> {
    /// Moves the nodes to where odometry and loops agree best.
    ///
    /// Loops count fully at first. If some are then further off than allowed, the kernel is sharpened step by step from
    /// the parabola to the truncated one (graduated non-convexity), so that loops that others contradict lose. A false
    /// loop that no other loop spans cannot be told by the graph.
    ///
    /// # Inputs
    /// * `work`: its contents do not matter; sizes as in [`GraphCapacities`](super::GraphCapacities).
    ///
    /// # Errors
    /// [`SolverFull`]: a slice of `work` is too small. Parts optimised before that one stay optimised.
    ///
    /// # Cost
    /// Linear in the nodes plus the fill of the nodes that loops touch, which is small where loops run in parallel.
    ///
    /// # Source
    /// Strasdat 2012, ch. 6 (pose graphs on Sim(3)); Madsen, Nielsen & Tingleff 2004, sec. 3.2; Yang, Antonante,
    /// Tzoumas & Carlone 2020, "Graduated non-convexity for robust spatial perception" (truncated least squares).
    pub fn optimize(
        &mut self,
        settings: &OptimizeSettings,
        work: &mut SolverStorage<'_>,
    ) -> Result<OptimizeReport, SolverFull> {
        let mut report = OptimizeReport {
            cost_before: 0.0,
            cost_after: 0.0,
            n_iterations: 0,
            n_optimized: 0,
            n_blocks: 0,
            n_rejected: 0,
            stop: Stop::Converged,
        };
        self.find_ends(settings.extent);
        let held = match settings.gauge {
            Gauge::First => Some(0),
            Gauge::Newest => self.n_nodes.checked_sub(1),
            Gauge::Keyframe(id) => self.nearest(id),
        };
        let before = held.and_then(|k| self.world_from_node(k));
        let mut outcome = Ok(());
        while let Some((part, n_loops)) = self.next_part() {
            outcome = self.settle(&part, n_loops, settings, work, &mut report);
            if outcome.is_err() {
                break;
            }
        }
        self.loops[..self.n_loops].sort_unstable_by_key(|l| l.serial);
        if let (Some(before), Some(after)) = (before, held.and_then(|k| self.world_from_node(k))) {
            self.carry(0, &(before * after.inverse()));
        }
        outcome.map(|()| report)
    }

    /// Looks up where the loops' ends are in the chain.
    fn find_ends(&mut self, extent: Extent) {
        let nodes = &self.nodes[..self.n_nodes];
        for edge in &mut self.loops[..self.n_loops] {
            edge.ends = [edge.from_id, edge.to_id].map(|id| nodes.partition_point(|n| n.keyframe_id < id));
            edge.is_settled &= extent == Extent::Changed;
        }
    }

    /// The first part of the chain with a loop that is not settled, grown to all loops that share an edge of the chain
    /// with it. Its loops are moved to the front and counted.
    fn next_part(&mut self) -> Option<(RangeInclusive<usize>, usize)> {
        let loops = &mut self.loops[..self.n_loops];
        let first = loops.iter().filter(|l| !l.is_settled).map(LoopEdge::span).min()?;
        let (mut start, mut end) = first;
        // The loops taken in stand in front; each one may make others overlap that did not before.
        let (mut n_inside, mut k) = (0, 0);
        while k < loops.len() {
            let (lo, hi) = loops[k].span();
            if lo < end && hi > start {
                (start, end) = (start.min(lo), end.max(hi));
                loops.swap(n_inside, k);
                n_inside += 1;
                k = n_inside;
            } else {
                k += 1;
            }
        }
        Some((start..=end, n_inside))
    }

    /// Optimises one part and carries along what follows it.
    fn settle(
        &mut self,
        part: &RangeInclusive<usize>,
        n_loops: usize,
        settings: &OptimizeSettings,
        work: &mut SolverStorage<'_>,
        report: &mut OptimizeReport,
    ) -> Result<(), SolverFull> {
        let end = *part.end();
        let Some(end_before) = self.world_from_node(end) else { return Ok(()) };
        let n_junctions = order_junctions(part, &self.loops[..n_loops], work)?;
        let mut problem = Part {
            nodes: &mut self.nodes[..self.n_nodes],
            loops: &mut self.loops[..n_loops],
            part: part.clone(),
            n_junctions,
            is_scale_free: settings.is_scale_free,
        };
        report.cost_before += problem.keep_and_cost(work);
        let (cost, stop) = problem.tell_apart(settings, work, &mut report.n_iterations);
        report.cost_after += cost;
        report.stop = stop;
        report.n_optimized += part.end() - part.start();
        report.n_rejected += problem.loops.iter().filter(|l| l.weight == 0.0).count();
        report.n_blocks = report.n_blocks.max(problem.n_blocks(work.junctions));
        if let Some(end_after) = self.world_from_node(end) {
            self.carry(end + 1, &(end_after * end_before.inverse()));
        }
        Ok(())
    }

    /// Moves all nodes from one on as a whole.
    fn carry(&mut self, first: usize, after_from_before: &Similarity) {
        for node in self.nodes[..self.n_nodes].iter_mut().skip(first) {
            node.world_from_node = renormalized(after_from_before * node.world_from_node);
        }
    }
}

impl LoopEdge {
    fn span(&self) -> (usize, usize) {
        let [i, j] = self.ends;
        (i.min(j), i.max(j))
    }
}
