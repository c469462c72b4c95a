//! What a budget grants each part of the program, in that part's own words.
//!
//! The plan prices the very same values that the parts are built from.

use super::{Budget, PlanInput, Row};
use crate::map_store::StoreCapacity;
use crate::mapping::MapperCapacity;
use crate::mapping::capacity::chunk_file_bytes;
use crate::splat::Capacities;
use kilogs_camera::ipc::FrameSlots;
use kilogs_core::correspondence::{DenseCapacities, sparse};
use kilogs_core::pose_graph::GraphCapacities;
use kilogs_core::store::page_file_bytes;
use kilogs_core::tracking::TrackerCapacities;

impl Budget {
    /// Slots of the camera's shared memory.
    pub fn frame_slots(&self) -> FrameSlots {
        FrameSlots::within(self.capacity(Row::IpcFrameSlots)).unwrap_or(FrameSlots::DEFAULT)
    }

    /// Tracks, landmarks and pyramids of the tracker.
    pub fn tracker_capacities(&self, input: &PlanInput) -> TrackerCapacities {
        TrackerCapacities {
            width: input.width as usize,
            height: input.height as usize,
            tracks: self.capacity(Row::TrackingTracks),
            landmarks: self.capacity(Row::TrackingLandmarks),
        }
    }

    /// Memory of the descriptor matcher.
    pub fn descriptor_bytes(&self, input: &PlanInput) -> usize {
        sparse::storage_bytes(input.width as usize, input.height as usize, self.capacity(Row::TrackingFeatures))
    }

    /// Images of the dense matcher.
    pub fn dense_capacities(&self, input: &PlanInput) -> DenseCapacities {
        DenseCapacities { width: input.width as usize, height: input.height as usize }
    }

    /// The pose graph of the loop closer: a street that is seen again has a loop every few keyframes, and neighboring loops
    /// fill few blocks of the factor.
    pub fn loop_graph(&self) -> GraphCapacities {
        let nodes = self.capacity(Row::LoopsGraphNodes);
        GraphCapacities { nodes, loops: nodes / 8, blocks: nodes }
    }

    /// Anchors and images of the mapper.
    pub fn mapper_capacity(&self) -> MapperCapacity {
        MapperCapacity {
            anchors: self.capacity(Row::MapAnchors),
            gaussians_per_anchor: self.capacity(Row::MapGaussiansPerAnchor),
            voxels: self.capacity(Row::MapVoxels),
            images: self.capacity(Row::MapKeyframeImages),
            depths: self.capacity(Row::MapKeyframeDepths),
            new_anchors: self.capacity(Row::MapNewAnchors),
            keyframe_rows: self.capacity(Row::MapKeyframes),
            chunk_rows: self.capacity(Row::MapChunks),
            pages: self.capacity(Row::MapPages),
            alignment_steps: self.capacity(Row::LoopsKeyframes),
            returning_files: self.capacity(Row::StoreReturningPages),
        }
    }

    /// Lists and pictures of the splat backend.
    pub fn splat_capacities(&self, input: &PlanInput) -> Capacities {
        Capacities {
            anchors: self.capacity(Row::MapAnchors),
            gaussians_per_anchor: self.capacity(Row::MapGaussiansPerAnchor),
            visible_gaussians: self.capacity(Row::SplatVisibleGaussians),
            row_entries: self.capacity(Row::SplatRowEntries),
            pairs: self.capacity(Row::SplatPairs),
            image_width_px: input.width,
            image_height_px: input.height,
            training_pixels: usize::try_from(input.mapping_pixels()).unwrap_or(usize::MAX),
            keyframe_rows: self.capacity(Row::MapKeyframes),
            chunk_rows: self.capacity(Row::MapChunks),
            exposure_slots: self.capacity(Row::MapKeyframeImages),
            learned_decoder: input.mapping.learned_decoder,
        }
    }

    /// Buffers of the map store. A page buffer takes a chunk as well; one image of the queue is the encoder's output.
    pub fn store_capacity(&self) -> StoreCapacity {
        let page_anchors = self.capacity(Row::StorePageAnchors);
        let page_gaussians = page_anchors.saturating_mul(self.capacity(Row::MapGaussiansPerAnchor));
        StoreCapacity {
            page_bytes: page_file_bytes(page_anchors, page_gaussians, true)
                .max(chunk_file_bytes(self.capacity(Row::MapGaussiansPerAnchor))),
            page_buffers: self.capacity(Row::StorePageQueue),
            image_buffers: self.capacity(Row::StoreImageQueue).saturating_sub(1),
            read_buffers: self.capacity(Row::StoreReturningPages),
        }
    }
}

/// Why capacities that are possible one by one are not possible together: the row, what is wrong, what to write.
pub(super) fn contradiction(budget: &Budget) -> Option<(Row, String, String)> {
    let of = |row| budget.capacity(row);
    let slots = of(Row::IpcFrameSlots);
    if budget.frame_slots().n_slots() != slots {
        let problem = format!("capacity {slots} cannot be shared out evenly");
        return Some((Row::IpcFrameSlots, problem, format!("write an odd number such as {}", slots + 1)));
    }
    let at_least = |row: Row, other: Row, needed: usize, why: &str| {
        let capacity = of(row);
        let problem = format!("capacity {capacity} is too small for [{other}] = {}: {why}", of(other));
        (capacity < needed).then(|| (row, problem, format!("write at least {needed}, or lower [{other}]")))
    };
    let anchors = of(Row::MapAnchors);
    at_least(Row::MapVoxels, Row::MapAnchors, (anchors * 4).div_ceil(3), "the hash stays at most three quarters full")
        .or_else(|| at_least(Row::MapAnchors, Row::MapNewAnchors, of(Row::MapNewAnchors), "one keyframe may fill it"))
        .or_else(|| {
            let rows = of(Row::MapKeyframes);
            at_least(Row::MapPages, Row::MapKeyframes, rows, "in the worst case each belongs to a page of its own")
        })
        .or_else(|| {
            let visible = of(Row::SplatVisibleGaussians);
            at_least(Row::SplatRowEntries, Row::SplatVisibleGaussians, visible, "each meets a row of tiles at least")
        })
        .or_else(|| {
            let visible = of(Row::SplatVisibleGaussians);
            at_least(Row::SplatPairs, Row::SplatVisibleGaussians, visible, "each meets a tile at least")
        })
}
