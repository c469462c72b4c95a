//! Keyframe poses over a whole drive: odometry between neighbors, loops between places seen twice.
//!
//! Minimises  sum_k |log(Z_k^-1 S_k^-1 S_k+1)|^2 + sum_l w_l |log(Z_l^-1 S_i^-1 S_j)|^2  over the similarities
//! `S = world_from_node`, each norm by the information of its edge, with `w_l` 0 for loops that the others contradict.
//! The nodes are a chain, and most of them touch no loop: the solver eliminates those one after the other, which leaves
//! a small sparse system of the nodes that do ([`optimize`](PoseGraph::optimize)).

mod block;
mod edge;
mod factor;
mod optimize;
mod order;
mod part;
mod storage;
mod thin;

pub use optimize::{Extent, Gauge, OptimizeReport, OptimizeSettings};
pub use storage::{Column, FactorBlock, GraphCapacities, Junction, SolverFull, SolverSlice, SolverStorage};

use crate::conventions::Similarity;
use crate::math::sim3::{self, Matrix7, Tangent7};
use core::fmt;

/// A keyframe of the skeleton, with the odometry edge from the node before it.
#[derive(Clone, Copy, Debug)]
pub struct Node {
    keyframe_id: u32,
    /// Touched by a loop: never thinned out.
    is_loop_end: bool,
    odometry_from_node: Similarity,
    world_from_node: Similarity,
    /// Of the edge from the node before, in this node's tangent.
    information: Matrix7,
}

impl Default for Node {
    fn default() -> Self {
        Self {
            keyframe_id: 0,
            is_loop_end: false,
            odometry_from_node: Similarity::identity(),
            world_from_node: Similarity::identity(),
            information: Matrix7::identity(),
        }
    }
}

/// A place seen twice, as measured.
#[derive(Clone, Copy, Debug)]
pub struct LoopMeasurement {
    /// One keyframe, and where the odometry put it.
    pub from: Place,
    /// The other one.
    pub to: Place,
    /// The measured similarity: points of the second in the first one's camera.
    pub from_from_to: Similarity,
    /// Information of the right increment of `from_from_to`, `[omega, upsilon, sigma]`.
    pub information: Matrix7,
}

/// A keyframe and its pose by odometry alone.
#[derive(Clone, Copy, Debug)]
pub struct Place {
    /// Which keyframe.
    pub keyframe_id: u32,
    /// In the frame that all nodes were pushed in.
    pub odometry_from_keyframe: Similarity,
}

/// A loop edge between two nodes of the skeleton.
#[derive(Clone, Copy, Debug)]
pub struct LoopEdge {
    from_id: u32,
    to_id: u32,
    to_from_from: Similarity,
    information: Matrix7,
    weight: f64,
    squared_sigmas: f64,
    is_settled: bool,
    /// Rejected, and asked once more whether the others can live with it.
    is_retried: bool,
    /// Loops pushed before it.
    serial: u32,
    /// Places of both ends in the chain while the graph is optimised.
    ends: [usize; 2],
}

impl Default for LoopEdge {
    fn default() -> Self {
        Self {
            from_id: 0,
            to_id: 0,
            to_from_from: Similarity::identity(),
            information: Matrix7::identity(),
            weight: 1.0,
            squared_sigmas: 0.0,
            is_settled: false,
            is_retried: false,
            serial: 0,
            ends: [0; 2],
        }
    }
}

/// What became of a loop in the last optimisation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoopVerdict {
    /// Keyframes of the nodes that it connects: those measured, or their nearest neighbors in the skeleton.
    pub keyframe_ids: [u32; 2],
    /// Squared residual in units of its variance; 7 on average for a true loop whose information is right.
    pub squared_sigmas: f64,
    /// The other edges contradict it: it has no influence.
    pub is_rejected: bool,
}

/// What cannot be pushed, and why; the graph is as before.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PushProblem {
    /// Keyframes come in ascending order; this one does not follow the last.
    OutOfOrder {
        /// The last one.
        last: u32,
    },
    /// A pose, a scale or an information that is not finite and positive: mend the measurement.
    NotFinite,
    /// No room, and nothing that may be dropped: give the graph more capacity, or go on without this edge.
    Full {
        /// How many there is room for.
        capacity: usize,
    },
    /// Both ends of the loop are one node of the skeleton: it says nothing, drop it.
    SameNode {
        /// The node's keyframe.
        keyframe_id: u32,
    },
    /// A loop before there are nodes.
    NoNodes,
}

impl fmt::Display for PushProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::OutOfOrder { last } => write!(f, "the keyframe does not follow keyframe {last}, the last one"),
            Self::NotFinite => write!(f, "a pose, scale or information is not finite and positive"),
            Self::Full { capacity } => write!(f, "all {capacity} places are in use and none may be given up"),
            Self::SameNode { keyframe_id } => write!(f, "both ends of the loop are the node of keyframe {keyframe_id}"),
            Self::NoNodes => write!(f, "a loop needs nodes to connect, and there are none"),
        }
    }
}

impl core::error::Error for PushProblem {}

/// Scales outside of this are no measurement.
const SCALES: [f64; 2] = [1e-4, 1e4];

/// Information of an edge whose errors are independent.
///
/// Source: own derivation, the inverse of a diagonal covariance.
pub fn information_of_sigmas(rotation_rad: f64, translation_m: f64, log_scale: f64) -> Matrix7 {
    let [r, t, s] = [rotation_rad, translation_m, log_scale].map(|sigma| 1.0 / (sigma * sigma));
    Matrix7::from_diagonal(&Tangent7::from([r, r, r, t, t, t, s]))
}

/// The skeleton of a drive and its loops, in the caller's memory.
#[derive(Debug)]
pub struct PoseGraph<'m> {
    nodes: &'m mut [Node],
    n_nodes: usize,
    loops: &'m mut [LoopEdge],
    n_loops: usize,
}

impl<'m> PoseGraph<'m> {
    /// An empty graph. `nodes` bounds the skeleton: when full, nodes without loops are thinned out, the oldest and densest
    /// first. `loops` bounds the loop edges: when full, new ones are refused.
    pub fn new(nodes: &'m mut [Node], loops: &'m mut [LoopEdge]) -> Self {
        Self { nodes, n_nodes: 0, loops, n_loops: 0 }
    }

    /// Appends a keyframe; its edge is the odometry from the node before it.
    ///
    /// # Inputs
    /// * `keyframe_id`: above that of the last node.
    /// * `odometry_from_node`: by odometry alone, in one frame for the whole drive, whatever loops did to the map.
    /// * `information`: of the step since the last keyframe pushed, right increment `[omega, upsilon, sigma]`. A step
    ///   that is a guess (tracking was lost) has little.
    ///
    /// # Errors
    /// [`PushProblem`]: out of order, not finite, or no node can be thinned out.
    pub fn push_node(
        &mut self,
        keyframe_id: u32,
        odometry_from_node: &Similarity,
        information: &Matrix7,
    ) -> Result<(), PushProblem> {
        if !is_usable(odometry_from_node, information) {
            return Err(PushProblem::NotFinite);
        }
        if let Some(last) = self.nodes().last().filter(|last| last.keyframe_id >= keyframe_id) {
            return Err(PushProblem::OutOfOrder { last: last.keyframe_id });
        }
        if self.n_nodes == self.nodes.len() {
            self.thin();
        }
        let world_from_node = match self.nodes().last() {
            Some(last) => last.carried(odometry_from_node),
            None => *odometry_from_node,
        };
        let capacity = self.nodes.len();
        let Some(slot) = self.nodes.get_mut(self.n_nodes) else { return Err(PushProblem::Full { capacity }) };
        *slot = Node {
            keyframe_id,
            is_loop_end: false,
            odometry_from_node: *odometry_from_node,
            world_from_node,
            information: *information,
        };
        self.n_nodes += 1;
        Ok(())
    }

    /// Adds a loop edge between the nodes nearest to two keyframes, which need not be in the skeleton themselves.
    ///
    /// # Errors
    /// [`PushProblem`]: no room, no nodes, not finite, or both ends at one node.
    pub fn push_loop(&mut self, measured: &LoopMeasurement) -> Result<(), PushProblem> {
        let is_place = |p: &Place| is_usable(&p.odometry_from_keyframe, &measured.information);
        if !is_usable(&measured.from_from_to, &measured.information)
            || ![measured.from, measured.to].iter().all(is_place)
        {
            return Err(PushProblem::NotFinite);
        }
        let (Some(i), Some(j)) = (self.nearest(measured.from.keyframe_id), self.nearest(measured.to.keyframe_id))
        else {
            return Err(PushProblem::NoNodes);
        };
        if i == j {
            return Err(PushProblem::SameNode { keyframe_id: self.nodes[i].keyframe_id });
        }
        let capacity = self.loops.len();
        let Some(slot) = self.loops.get_mut(self.n_loops) else { return Err(PushProblem::Full { capacity }) };
        let (from, to) = (&self.nodes[i], &self.nodes[j]);
        let from_from_node = measured.from.odometry_from_keyframe.inverse() * from.odometry_from_node;
        let to_from_node = measured.to.odometry_from_keyframe.inverse() * to.odometry_from_node;
        // The residual at the keyframes is Ad(to_from_node) times that at the nodes.
        let carry = sim3::adjoint(&to_from_node);
        *slot = LoopEdge {
            from_id: from.keyframe_id,
            to_id: to.keyframe_id,
            to_from_from: to_from_node.inverse() * measured.from_from_to.inverse() * from_from_node,
            information: carry.transpose() * measured.information * carry,
            serial: self.n_loops as u32,
            ..LoopEdge::default()
        };
        self.n_loops += 1;
        self.nodes[i].is_loop_end = true;
        self.nodes[j].is_loop_end = true;
        Ok(())
    }

    /// Takes back the loop pushed last, for a caller that does not like what it does.
    pub fn pop_loop(&mut self) {
        self.n_loops = self.n_loops.saturating_sub(1);
    }

    /// Lays all nodes out as odometry has them, from the first one on: a start that no loop has bent, after
    /// [`pop_loop`](Self::pop_loop).
    pub fn lay_out(&mut self) {
        let Some(first) = self.nodes().first().copied() else { return };
        for node in &mut self.nodes[..self.n_nodes] {
            node.world_from_node = first.carried(&node.odometry_from_node);
        }
    }

    /// Nodes of the skeleton.
    pub fn n_nodes(&self) -> usize {
        self.n_nodes
    }

    /// Keyframe of a node.
    pub fn keyframe_id(&self, node: usize) -> Option<u32> {
        self.nodes().get(node).map(|n| n.keyframe_id)
    }

    /// Where a node stands.
    pub fn world_from_node(&self, node: usize) -> Option<Similarity> {
        self.nodes().get(node).map(|n| n.world_from_node)
    }

    /// All loops with their verdicts, as they were pushed.
    pub fn loops(&self) -> impl Iterator<Item = LoopVerdict> + '_ {
        self.loops[..self.n_loops].iter().map(|l| LoopVerdict {
            keyframe_ids: [l.from_id, l.to_id],
            squared_sigmas: l.squared_sigmas,
            is_rejected: l.weight == 0.0,
        })
    }

    /// Where a keyframe stands that may not be in the skeleton: carried along by its neighbors there, blended by its
    /// place between them. `None` without nodes.
    ///
    /// # Source
    /// Own derivation: the geodesic between what both neighbors say, which agree where nothing was corrected.
    pub fn world_from_keyframe(&self, place: &Place) -> Option<Similarity> {
        let after = self.nodes().partition_point(|n| n.keyframe_id <= place.keyframe_id);
        let before = after.checked_sub(1).and_then(|k| self.nodes().get(k));
        match (before, self.nodes().get(after)) {
            (Some(a), Some(b)) => {
                let share = f64::from(place.keyframe_id - a.keyframe_id) / f64::from(b.keyframe_id - a.keyframe_id);
                let by_a = a.carried(&place.odometry_from_keyframe);
                let by_b = b.carried(&place.odometry_from_keyframe);
                Some(by_a * sim3::exp(&(sim3::log(&(by_a.inverse() * by_b)) * share)))
            }
            (Some(only), None) | (None, Some(only)) => Some(only.carried(&place.odometry_from_keyframe)),
            (None, None) => None,
        }
    }

    fn nodes(&self) -> &[Node] {
        &self.nodes[..self.n_nodes]
    }

    /// Index of the node nearest to a keyframe.
    fn nearest(&self, keyframe_id: u32) -> Option<usize> {
        let after = self.nodes().partition_point(|n| n.keyframe_id < keyframe_id);
        let off = |k: &usize| self.nodes().get(*k).map_or(u32::MAX, |n| n.keyframe_id.abs_diff(keyframe_id));
        [after.saturating_sub(1), after].into_iter().filter(|&k| k < self.n_nodes).min_by_key(off)
    }
}

impl Node {
    /// Where this node carries a pose of the odometry.
    fn carried(&self, odometry_from_pose: &Similarity) -> Similarity {
        renormalized(self.world_from_node * (self.odometry_from_node.inverse() * odometry_from_pose))
    }

    /// The odometry edge that ends here, inverted: `node_from_previous`.
    fn node_from_previous(&self, previous: &Self) -> Similarity {
        self.odometry_from_node.inverse() * previous.odometry_from_node
    }
}

fn is_usable(similarity: &Similarity, information: &Matrix7) -> bool {
    let [least, most] = SCALES;
    (least..=most).contains(&similarity.scaling())
        && similarity.isometry.translation.vector.iter().all(|x| x.is_finite())
        && similarity.isometry.rotation.coords.iter().all(|x| x.is_finite())
        && information.iter().all(|x| x.is_finite())
        && information.diagonal().iter().all(|&x| x > 0.0)
}

fn renormalized(mut similarity: Similarity) -> Similarity {
    similarity.isometry.rotation.renormalize();
    similarity
}

#[cfg(test)]
mod tests;
