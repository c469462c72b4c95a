//! What closing loops takes, and the memory of the closer.

use super::places_file::{PlacesFile, RECORD_BYTES};
use crate::map_store::Alignment;
use crate::pipeline::matchers::kept;
use kilogs_core::features::descriptors::half_step_bytes;
use kilogs_core::features::{Corner, Feature, FeatureMatch, Nearest};
use kilogs_core::frame::pyramid;
use kilogs_core::loop_closure::{KeptPlace, LoopCapacities, LoopStorage};
use kilogs_core::places::{
    self, LoopScratch, PlaceSlot, PlaceStorage, PointDepth, Posting, Tally, WORDS_PER_PLACE, bytes_per_point,
};
use kilogs_core::pose::{Match, PointMatch};
use kilogs_core::pose_graph::{Column, FactorBlock, Junction, LoopEdge, Node, Place, SolverStorage};
use kilogs_core::tracking::{FrameReport, KeyframePoint, PYRAMID_LEVELS};

/// Bytes of a keyframe that can be recognized.
pub const BYTES_PER_PLACE: usize = places::BYTES_PER_PLACE + size_of::<KeptPlace>();

/// Bytes of a keyframe of the map: where odometry put it, and how it has moved, as the loop closer and as the mapper know it.
pub const BYTES_PER_KEYFRAME: usize = size_of::<Place>() + 2 * Alignment::BYTES_PER_STEP;

/// Larger vocabularies are refused, bytes of the file.
pub const MAX_VOCABULARY_BYTES: usize = 640 << 10;

/// Bytes of a keyframe on its way.
pub fn bytes_per_job(n_pixels: u64, n_tracks: usize) -> usize {
    n_pixels as usize + size_of::<FrameReport>() + n_tracks * size_of::<KeyframePoint>()
}

/// Bytes of what one keyframe is described and compared in, and of the vocabulary; `n_points` features become words.
pub fn workspace_bytes(width: usize, height: usize, n_points: usize) -> usize {
    // A word takes 40 bytes of the file and 4 of the index.
    let of_vocabulary = MAX_VOCABULARY_BYTES + MAX_VOCABULARY_BYTES / 10;
    let of_images = pyramid::bytes_needed(width, height, PYRAMID_LEVELS) + half_step_bytes(width, height);
    let of_features = size_of::<Feature>() + size_of::<Corner>() + size_of::<Tally>();
    let of_points = 2 * (size_of::<Feature>() + size_of::<PointDepth>()) + RECORD_BYTES + bytes_per_point();
    of_vocabulary + of_images + n_points * (of_features + of_points)
}

/// The closer's memory, which lives as long as the process.
pub fn storage(capacities: &LoopCapacities, points: PlacesFile) -> LoopStorage<'static> {
    let LoopCapacities { places, words, features, points: n_points, graph } = *capacities;
    LoopStorage {
        index: PlaceStorage {
            slots: kept(PlaceSlot::UNUSED, places),
            postings: kept(Posting::UNUSED, places * WORDS_PER_PLACE),
            first_of_word: kept(0, words),
        },
        kept: kept(KeptPlace::default(), places),
        points: Box::leak(Box::new(points)),
        tally: kept(Tally::default(), features),
        scratch: LoopScratch {
            nearest: kept(Nearest::NONE, 2 * n_points),
            pairs: kept(FeatureMatch::default(), n_points),
            matches: kept(Match::default(), n_points),
            point_matches: kept(PointMatch::default(), n_points),
            is_inlier: kept(false, n_points),
        },
        nodes: kept(Node::default(), graph.nodes),
        loops: kept(LoopEdge::default(), graph.loops),
        solver: SolverStorage {
            columns: kept(Column::default(), graph.nodes),
            junctions: kept(Junction::default(), graph.junctions()),
            neighbors: kept(u64::MAX, graph.neighbor_words()),
            blocks: kept(FactorBlock::default(), graph.blocks),
        },
    }
}
