//! The rows a budget file must have, and what this version can do with each.

use std::fmt;
use std::ops::RangeInclusive;

/// Where the memory of a row lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Location {
    /// This process's heap, or the capture process's for its own row.
    Host,
    /// The compute device; host memory when the backend has none of its own.
    Device,
    /// A host copy and a device copy; one copy when the backend has no memory of its own.
    Both,
    /// Shared memory between the capture process and this one.
    Ipc,
}

impl Location {
    pub(super) const ALL: [Self; 4] = [Self::Host, Self::Device, Self::Both, Self::Ipc];

    /// As written in a budget file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Host => "host",
            Self::Device => "device",
            Self::Both => "both",
            Self::Ipc => "ipc",
        }
    }
}

/// What happens when a container is full.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WhenFull {
    /// The newcomer is not taken, and counted.
    Refuse,
    /// The oldest element makes room.
    OverwriteOldest,
    /// The element with the lowest score makes room.
    EvictWorst,
}

impl WhenFull {
    pub(super) const ALL: [Self; 3] = [Self::Refuse, Self::OverwriteOldest, Self::EvictWorst];

    /// As written in a budget file and in `report.json`.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Refuse => "refuse",
            Self::OverwriteOldest => "overwrite-oldest",
            Self::EvictWorst => "evict-worst",
        }
    }
}

/// One capacity of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs, reason = "each row is described by `RowSpec::element`, which the table prints")]
pub enum Row {
    IpcFrameSlots,
    TrackingGrayImages,
    TrackingPyramids,
    TrackingTracks,
    TrackingLandmarks,
    TrackingKeyframes,
    TrackingFeatures,
    TrackingDenseMatchers,
    TrackingSpeedReadings,
    PipelineKeyframeQueue,
    PipelineLoopQueue,
    LoopsPlaces,
    LoopsPoints,
    LoopsKeyframes,
    LoopsGraphNodes,
    LoopsWorkspaces,
    MapAnchors,
    MapGaussiansPerAnchor,
    MapNewAnchors,
    MapVoxels,
    MapKeyframes,
    MapKeyframeImages,
    MapKeyframeDepths,
    MapWorkspaces,
    MapChunks,
    MapPages,
    SplatVisibleGaussians,
    SplatRowEntries,
    SplatPairs,
    SplatViews,
    StorePageAnchors,
    StorePageQueue,
    StoreReturningPages,
    StoreImageQueue,
    StoreKeyframeTable,
    TelemetryFrameRecords,
    InferenceArena,
    ProcessCodeAndStacks,
    ProcessComputeDriver,
    ProcessCameraChild,
}

/// What the program knows about a row before a file is read.
#[derive(Debug)]
pub struct RowSpec {
    /// Which row.
    pub row: Row,
    /// Section of the file.
    pub section: &'static str,
    /// Name within the section.
    pub name: &'static str,
    /// What one element is.
    pub element: &'static str,
    /// Where this version can put it.
    pub locations: &'static [Location],
    /// What this version does when it is full.
    pub when_full: WhenFull,
    /// Capacities that the program can work with.
    pub range: RangeInclusive<u64>,
}

const HOST: &[Location] = &[Location::Host];
const BACKEND: &[Location] = &[Location::Both, Location::Device];

macro_rules! rows {
    ($($row:ident = [$section:literal . $name:literal], $element:literal, $locations:expr, $when_full:ident, $range:expr;)*) => {
        /// Every row, in the order of the data flow.
        pub static ROWS: [RowSpec; Row::COUNT] = [$(RowSpec {
            row: Row::$row,
            section: $section,
            name: $name,
            element: $element,
            locations: $locations,
            when_full: WhenFull::$when_full,
            range: $range,
        }),*];
    };
}

rows! {
    IpcFrameSlots = ["ipc"."frame_slots"], "a camera frame in shared memory", &[Location::Ipc], OverwriteOldest, 7..=63;
    TrackingGrayImages = ["tracking"."gray_images"], "the current frame in grey", HOST, OverwriteOldest, 1..=1;
    TrackingPyramids = ["tracking"."pyramids"], "a grey image with its smaller levels", HOST, OverwriteOldest, 3..=3;
    TrackingTracks = ["tracking"."tracks"], "a point followed from frame to frame, its match and its scratch", HOST, Refuse, 64..=1 << 16;
    TrackingLandmarks = ["tracking"."landmarks"], "a point of the window and where it was seen", HOST, Refuse, 64..=1 << 18;
    TrackingKeyframes = ["tracking"."keyframes"], "a keyframe of the window and its part of the bundle adjustment", HOST, OverwriteOldest, 8..=8;
    TrackingFeatures = ["tracking"."features"], "a described corner of the keyframe and one of the current frame, and their match", HOST, Refuse, 64..=1 << 16;
    TrackingDenseMatchers = ["tracking"."dense_matchers"], "the work space of dense matching", HOST, Refuse, 1..=1;
    TrackingSpeedReadings = ["tracking"."speed_readings"], "a reading of the vehicle's speed", HOST, OverwriteOldest, 16..=1 << 16;
    PipelineKeyframeQueue = ["pipeline"."keyframe_queue"], "a keyframe on its way to the mapper", HOST, Refuse, 1..=64;
    PipelineLoopQueue = ["pipeline"."loop_queue"], "a keyframe on its way to the loop closer", HOST, Refuse, 1..=64;
    LoopsPlaces = ["loops"."places"], "a keyframe that can be recognized; its points are on disk", HOST, EvictWorst, 64..=1 << 20;
    LoopsPoints = ["loops"."points"], "counted in loops.workspaces", HOST, Refuse, 64..=8192;
    LoopsKeyframes = ["loops"."keyframes"], "where odometry put a keyframe, and where it is in the map", HOST, Refuse, 64..=1 << 24;
    LoopsGraphNodes = ["loops"."graph_nodes"], "a keyframe of the pose graph's skeleton, with its part of the equations", HOST, EvictWorst, 64..=1 << 20;
    LoopsWorkspaces = ["loops"."workspaces"], "the vocabulary, and what one keyframe is described and compared in", HOST, Refuse, 1..=1;
    MapAnchors = ["map"."anchors"], "an anchor with its trainable numbers, feature and their moments", BACKEND, Refuse, 64..=1 << 24;
    MapGaussiansPerAnchor = ["map"."gaussians_per_anchor"], "counted in map.anchors", BACKEND, Refuse, 1..=32;
    MapNewAnchors = ["map"."new_anchors"], "an anchor that a keyframe is about to spawn", HOST, Refuse, 16..=1 << 20;
    MapVoxels = ["map"."voxels"], "a slot of the voxel hash", HOST, Refuse, 64..=1 << 26;
    MapKeyframes = ["map"."keyframes"], "a resident keyframe's placement", BACKEND, EvictWorst, 4..=1 << 16;
    MapKeyframeImages = ["map"."keyframe_images"], "a keyframe image to train on, and its exposure", HOST, OverwriteOldest, 2..=4096;
    MapKeyframeDepths = ["map"."keyframe_depths"], "a keyframe's depth and confidence to train on", HOST, OverwriteOldest, 1..=4096;
    MapWorkspaces = ["map"."workspaces"], "planes of motion stereo and insertion", HOST, Refuse, 1..=1;
    MapChunks = ["map"."chunks"], "a resident chunk's background and decoder with their moments", BACKEND, EvictWorst, 2..=1 << 12;
    MapPages = ["map"."pages"], "what is known of ten keyframes' pages: where they are, what is on disk", HOST, EvictWorst, 16..=1 << 20;
    SplatVisibleGaussians = ["splat"."visible_gaussians"], "a decoded and projected Gaussian and its gradient", BACKEND, Refuse, 64..=1 << 26;
    SplatRowEntries = ["splat"."row_entries"], "a (row of tiles, Gaussian) entry and its gradient", BACKEND, Refuse, 64..=1 << 27;
    SplatPairs = ["splat"."pairs"], "a (tile, Gaussian) pair", BACKEND, Refuse, 64..=1 << 28;
    SplatViews = ["splat"."views"], "the pixels of a view: drawn at native size, learned at mapping size", BACKEND, Refuse, 1..=1;
    StorePageAnchors = ["store"."page_anchors"], "counted in store.page_queue", HOST, Refuse, 16..=1 << 20;
    StorePageQueue = ["store"."page_queue"], "a page on its way to the disk", HOST, Refuse, 1..=64;
    StoreReturningPages = ["store"."returning_pages"], "a page or chunk on its way back from the disk", HOST, Refuse, 2..=64;
    StoreImageQueue = ["store"."image_queue"], "a keyframe image on its way to the disk, or the encoder's output", HOST, Refuse, 2..=256;
    StoreKeyframeTable = ["store"."keyframe_table"], "a keyframe and a page of the finished map, to judge it", HOST, Refuse, 64..=1 << 24;
    TelemetryFrameRecords = ["telemetry"."frame_records"], "a frame's figures on their way to the log", HOST, Refuse, 8..=1 << 20;
    InferenceArena = ["inference"."arena"], "a byte of the heap of the inference thread; none without trained networks", HOST, Refuse, 1 << 20..=1 << 36;
    ProcessCodeAndStacks = ["process"."code_and_stacks"], "a byte of code, thread stacks, allocator slack, iceoryx2", HOST, Refuse, 1 << 20..=1 << 32;
    ProcessComputeDriver = ["process"."compute_driver"], "a byte of the compute device's driver; none without a device", HOST, Refuse, 1 << 20..=1 << 32;
    ProcessCameraChild = ["process"."camera_child"], "a byte of the capture process beside the shared frames", HOST, Refuse, 1 << 20..=1 << 32;
}

impl Row {
    /// How many rows there are.
    pub const COUNT: usize = Self::ProcessCameraChild as usize + 1;

    /// What the program knows about this row.
    pub fn spec(self) -> &'static RowSpec {
        &ROWS[self as usize]
    }

    /// The capacity counts bytes, so that a file may say `30 MiB`.
    pub fn counts_bytes(self) -> bool {
        matches!(
            self,
            Self::InferenceArena | Self::ProcessCodeAndStacks | Self::ProcessComputeDriver | Self::ProcessCameraChild
        )
    }
}

impl fmt::Display for Row {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let spec = self.spec();
        f.pad(&format!("{}.{}", spec.section, spec.name))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_row_finds_its_own_description() {
        for (idx, spec) in ROWS.iter().enumerate() {
            assert_eq!(spec.row as usize, idx, "{}", spec.row);
            assert!(!spec.locations.is_empty() && spec.range.start() > &0, "{}", spec.row);
        }
    }
}
