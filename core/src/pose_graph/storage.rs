//! The memory that a graph and its solver work in.

use super::{LoopEdge, Node};
use crate::conventions::Similarity;
use crate::math::sim3::{Matrix7, Tangent7};
use core::fmt;

/// No junction, no place in the order.
pub(super) const NONE: u32 = u32::MAX;

/// One node's part of the equations.
#[derive(Clone, Copy, Debug)]
pub struct Column {
    pub(super) diagonal: Matrix7,
    /// Coupling of the next node in the chain (rows) with this one.
    pub(super) to_next: Matrix7,
    /// Coupling of the junction before it in the chain (rows) with this node.
    pub(super) to_left: Matrix7,
    pub(super) gradient: Tangent7,
    pub(super) candidate: Similarity,
    /// Number of the node among those that loops touch.
    pub(super) junction: u32,
    /// Node of the junction before it.
    pub(super) left: u32,
}

impl Default for Column {
    fn default() -> Self {
        Self {
            diagonal: Matrix7::zeros(),
            to_next: Matrix7::zeros(),
            to_left: Matrix7::zeros(),
            gradient: Tangent7::zeros(),
            candidate: Similarity::identity(),
            junction: NONE,
            left: NONE,
        }
    }
}

/// A node that loops touch, and, under the same index, a place in the order of elimination.
#[derive(Clone, Copy, Debug, Default)]
pub struct Junction {
    pub(super) node: u32,
    pub(super) place: u32,
    pub(super) degree: u32,
    /// Junction eliminated at this place.
    pub(super) at: u32,
    /// Its blocks below the diagonal.
    pub(super) blocks: [u32; 2],
}

/// A block of the factor below the diagonal.
#[derive(Clone, Copy, Debug)]
pub struct FactorBlock {
    pub(super) row: u32,
    pub(super) block: Matrix7,
}

impl Default for FactorBlock {
    fn default() -> Self {
        Self { row: NONE, block: Matrix7::zeros() }
    }
}

/// Work space of [`PoseGraph::optimize`](super::PoseGraph::optimize).
#[derive(Debug)]
pub struct SolverStorage<'m> {
    /// One per node of the graph.
    pub columns: &'m mut [Column],
    /// One per node that loops touch: at most two per loop.
    pub junctions: &'m mut [Junction],
    /// Bits of who neighbors whom: [`GraphCapacities::neighbor_words`].
    pub neighbors: &'m mut [u64],
    /// Blocks that elimination of the junctions fills.
    pub blocks: &'m mut [FactorBlock],
}

/// How much a graph and its solver hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct GraphCapacities {
    /// Nodes of the skeleton.
    pub nodes: usize,
    /// Loop edges.
    pub loops: usize,
    /// Blocks of the factor between nodes that loops touch.
    pub blocks: usize,
}

impl GraphCapacities {
    /// Nodes that loops can touch.
    pub const fn junctions(&self) -> usize {
        2 * self.loops
    }

    /// Words of [`SolverStorage::neighbors`].
    pub const fn neighbor_words(&self) -> usize {
        self.junctions() * self.junctions().div_ceil(u64::BITS as usize)
    }

    /// Bytes of all slices of the graph and its solver.
    pub const fn bytes(&self) -> usize {
        self.nodes * (size_of::<Node>() + size_of::<Column>())
            + self.loops * size_of::<LoopEdge>()
            + self.junctions() * size_of::<Junction>()
            + self.neighbor_words() * size_of::<u64>()
            + self.blocks * size_of::<FactorBlock>()
    }
}

/// The work space is too small for this graph.
///
/// Nothing was changed. Give it more, or take back the loop pushed last.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SolverFull {
    /// Which slice.
    pub what: SolverSlice,
    /// Elements needed, as far as was counted.
    pub needed: u32,
}

/// A slice of [`SolverStorage`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SolverSlice {
    /// [`SolverStorage::columns`].
    Columns,
    /// [`SolverStorage::junctions`].
    Junctions,
    /// [`SolverStorage::neighbors`].
    Neighbors,
    /// [`SolverStorage::blocks`].
    Blocks,
}

impl fmt::Display for SolverFull {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let what = match self.what {
            SolverSlice::Columns => "columns",
            SolverSlice::Junctions => "junctions",
            SolverSlice::Neighbors => "neighbor words",
            SolverSlice::Blocks => "factor blocks",
        };
        write!(f, "the pose graph's solver needs {} {what}, more than it was given", self.needed)
    }
}

impl core::error::Error for SolverFull {}

impl SolverFull {
    pub(super) fn unless(fits: bool, what: SolverSlice, needed: usize) -> Result<(), Self> {
        if fits { Ok(()) } else { Err(Self { what, needed: u32::try_from(needed).unwrap_or(u32::MAX) }) }
    }
}
