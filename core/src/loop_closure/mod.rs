//! Closing loops: a keyframe in, the places of all keyframes out.
//!
//! [`LoopCloser`] joins [`places`](crate::places) (which keyframe shows the same place, and how do the two cameras stand to
//! each other) with the [`pose_graph`](crate::pose_graph) (what does that say about all others). It takes one
//! [`KeyframePacket`] per keyframe, owns its memory and never looks back at the tracker, so it can run on a thread of its
//! own, late, or not at all. Tracking goes on in its own unbroken frame; [`MapAlignment`] moves that frame to where the map
//! is now, in steps too small to be felt.

mod alignment;
mod closer;
mod outcome;
mod points;
mod settings;
mod storage;

pub use alignment::{AlignmentLimits, MapAlignment};
pub use closer::{KeyframePacket, LoopCloser};
pub use outcome::{JudgedCandidate, KeyframeOutcome, LoopDecision};
pub use points::{PlacePoints, PointsInMemory};
pub use settings::{LoopSettings, OdometryNoise};
pub use storage::{KeptPlace, LoopCapacities, LoopStorage, LoopStorageTooSmall};

#[cfg(test)]
mod tests;
