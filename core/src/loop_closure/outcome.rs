//! What became of a keyframe and of the places that it was compared with.

use crate::places::{LoopEvidence, MAX_CANDIDATES, PlaceCandidate, Remembered};
use crate::pose_graph::{OptimizeReport, PushProblem, SolverFull};
use heapless::Vec;

/// What was decided about a candidate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LoopDecision {
    /// It is a loop, and the graph has moved.
    Accepted,
    /// Too few keyframes in a row led there.
    NotConsistent,
    /// A loop was closed just before; the next one says the same.
    TooSoon,
    /// A better candidate of the same keyframe was accepted.
    AnotherAccepted,
    /// Nothing is kept of that keyframe.
    Forgotten,
    /// Verification refused; [`LoopEvidence::verdict`] says which bar.
    NotVerified,
    /// The loop says nothing about some direction.
    Degenerate,
    /// The graph did not take the loop.
    NotPushed(PushProblem),
    /// The solver had no room for the graph with this loop.
    NotSolved(SolverFull),
    /// The graph cannot live with it and all loops before.
    Contradicted,
    /// The odometry would have to be wrong by more than it ever is.
    TooFarOff,
}

/// A candidate with the numbers that decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JudgedCandidate {
    /// What recognition said.
    pub candidate: PlaceCandidate,
    /// What was decided.
    pub decision: LoopDecision,
    /// What verification measured, if it was asked.
    pub evidence: Option<LoopEvidence>,
    /// Squared residual of the loop in the optimised graph in units of its variance; NaN when not tried.
    pub squared_sigmas: f64,
    /// What the loop added to the cost of the graph, in the same units; NaN when not tried.
    pub added_cost: f64,
}

/// What became of a keyframe.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyframeOutcome {
    /// Whether it can be found again.
    pub remembered: Remembered,
    /// The places it was compared with, best first.
    pub candidates: Vec<JudgedCandidate, MAX_CANDIDATES>,
    /// The optimisation, if a loop was closed.
    pub optimized: Option<OptimizeReport>,
}
