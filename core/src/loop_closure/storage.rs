//! The memory that closing loops works in.

use super::points::PlacePoints;
use crate::conventions::Similarity;
use crate::places::{
    LoopScratch, PlaceStorage, PlaceStorageTooSmall, PlaceView, Remembered, Signature, Tally, bytes_per_point,
    index_bytes,
};
use crate::pose_graph::{GraphCapacities, LoopEdge, Node, Place, SolverStorage};
use core::fmt;

/// How much a [`LoopCloser`](super::LoopCloser) holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LoopCapacities {
    /// Keyframes that can be recognized; at least three. When full, the most redundant one gives way.
    pub places: usize,
    /// Words of the vocabulary.
    pub words: usize,
    /// Features of a keyframe that become words; what is beyond is not looked at.
    pub features: usize,
    /// Described points of a keyframe that are compared; what is beyond is not looked at.
    pub points: usize,
    /// The pose graph.
    pub graph: GraphCapacities,
}

impl LoopCapacities {
    /// Bytes of all slices of a [`LoopStorage`]; its [`PlacePoints`] are not among them.
    pub const fn bytes(&self) -> usize {
        index_bytes(self.places, self.words)
            + self.places * size_of::<KeptPlace>()
            + self.features * size_of::<Tally>()
            + self.points * bytes_per_point()
            + self.graph.bytes()
    }
}

/// No keyframe: a slot that nobody uses.
const NOBODY: u32 = u32::MAX;

/// What is kept of a keyframe beside its points.
#[derive(Clone, Copy, Debug)]
pub struct KeptPlace {
    place: Place,
}

impl Default for KeptPlace {
    fn default() -> Self {
        Self { place: Place { keyframe_id: NOBODY, odometry_from_keyframe: Similarity::identity() } }
    }
}

/// Memory of a [`LoopCloser`](super::LoopCloser); sizes follow from [`LoopCapacities`].
#[derive(Debug)]
pub struct LoopStorage<'m> {
    /// The index; `places` slots.
    pub index: PlaceStorage<'m>,
    /// `places`.
    pub kept: &'m mut [KeptPlace],
    /// A slot for each of the `places`, with room for `points`.
    pub points: &'m mut (dyn PlacePoints + Send),
    /// `features`.
    pub tally: &'m mut [Tally],
    /// Of verification: `nearest` has twice `points`, the others `points`.
    pub scratch: LoopScratch<'m>,
    /// The graph's nodes.
    pub nodes: &'m mut [Node],
    /// The graph's loops.
    pub loops: &'m mut [LoopEdge],
    /// The graph's solver.
    pub solver: SolverStorage<'m>,
}

/// A slice of a [`LoopStorage`] is too short: a mistake of the caller, to be mended there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LoopStorageTooSmall {
    /// Which slice.
    pub what: &'static str,
    /// Elements that are there.
    pub found: usize,
    /// Elements that are needed.
    pub needed: usize,
}

impl fmt::Display for LoopStorageTooSmall {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "closing loops needs {} elements of {}, found {}", self.needed, self.what, self.found)
    }
}

impl core::error::Error for LoopStorageTooSmall {}

impl From<PlaceStorageTooSmall> for LoopStorageTooSmall {
    fn from(small: PlaceStorageTooSmall) -> Self {
        Self { what: "the place index", found: small.found as usize, needed: small.needed as usize }
    }
}

impl LoopStorage<'_> {
    pub(super) fn check(&self, capacities: &LoopCapacities) -> Result<(), LoopStorageTooSmall> {
        let LoopCapacities { places, points, features, words, graph } = *capacities;
        let slices = [
            ("index.slots", self.index.slots.len(), places),
            ("index.first_of_word", self.index.first_of_word.len(), words),
            ("kept", self.kept.len(), places),
            ("tally", self.tally.len(), features),
            ("scratch.nearest", self.scratch.nearest.len(), 2 * points),
            ("scratch.pairs", self.scratch.pairs.len(), points),
            ("scratch.matches", self.scratch.matches.len(), points),
            ("scratch.point_matches", self.scratch.point_matches.len(), points),
            ("scratch.is_inlier", self.scratch.is_inlier.len(), points),
            ("nodes", self.nodes.len(), graph.nodes),
            ("loops", self.loops.len(), graph.loops),
            ("solver.columns", self.solver.columns.len(), graph.nodes),
            ("solver.junctions", self.solver.junctions.len(), graph.junctions()),
            ("solver.neighbors", self.solver.neighbors.len(), graph.neighbor_words()),
            ("solver.blocks", self.solver.blocks.len(), graph.blocks),
        ];
        match slices.into_iter().find(|(_, found, needed)| found < needed) {
            Some((what, found, needed)) => Err(LoopStorageTooSmall { what, found, needed }),
            None => Ok(()),
        }
    }
}

/// The keyframes in the index.
#[derive(Debug)]
pub(super) struct KeptPlaces<'m> {
    pub kept: &'m mut [KeptPlace],
    pub points: &'m mut (dyn PlacePoints + Send),
    pub n_kept: usize,
}

impl KeptPlaces<'_> {
    /// Keeps what the index has remembered, where it forgot another.
    pub(super) fn keep(&mut self, place: &Place, words: &Signature, view: &PlaceView<'_>, remembered: Remembered) {
        let slot = match remembered {
            Remembered::NotLater { .. } => return,
            Remembered::Added => {
                self.n_kept += 1;
                Some(self.n_kept - 1)
            }
            Remembered::Instead { of } => self.slot(of),
        };
        let Some(slot) = slot else { return };
        if let Some(kept) = self.kept.get_mut(slot) {
            *kept = KeptPlace { place: *place };
            self.points.keep(slot, place.keyframe_id, words, view);
        }
    }

    /// Knows again what a slot has kept since an earlier drive; another one's gives way, if the index says so.
    pub(super) fn recall(&mut self, slot: usize, place: &Place, remembered: Remembered) {
        let forgotten = match remembered {
            Remembered::Instead { of } => self.slot(of),
            Remembered::Added | Remembered::NotLater { .. } => None,
        };
        if let Some(forgotten) = forgotten.and_then(|slot| self.kept.get_mut(slot)) {
            *forgotten = KeptPlace::default();
        }
        if let Some(kept) = self.kept.get_mut(slot) {
            *kept = KeptPlace { place: *place };
            self.n_kept = self.n_kept.max(slot + 1);
        }
    }

    /// Where a keyframe stood, and its points.
    pub(super) fn find(&mut self, ordinal: u32) -> Option<(Place, PlaceView<'_>)> {
        let slot = self.slot(ordinal)?;
        let place = self.kept.get(slot)?.place;
        Some((place, self.points.find(slot)?))
    }

    fn slot(&self, ordinal: u32) -> Option<usize> {
        self.kept.iter().take(self.n_kept).position(|kept| kept.place.keyframe_id == ordinal)
    }
}
