//! What one element of each row costs. Sizes come from the types that are stored, never from the file.

use super::{Budget, Location, Row};
use crate::map_store::PictureRule;
use crate::mapping::{MapperSettings, capacity as mapper, mapping_camera};
use crate::output::StageTimes;
use crate::pipeline::loops;
use crate::splat::cpu::CpuBackend;
use crate::splat::device::{HostCopy, arena_bytes};
use crate::splat::program::buffer_plan;
use crate::splat::{Capacities, MemoryRow};
use kilogs_camera::ipc::Speed;
use kilogs_core::bundle::ReducedSystem;
use kilogs_core::camera::Pinhole;
use kilogs_core::keyframe::{KeyframeWindow, WINDOW};
use kilogs_core::store::{PageLabel, StoredKeyframe};
use kilogs_core::tracking::{BYTES_PER_LANDMARK, BYTES_PER_TRACK, FrameReport, KeyframePoint};

/// What settings of the mapper memory depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MappingPlan {
    /// Size of the training images relative to the camera's, `mapping.resolution`.
    pub resolution: f64,
    /// Keyframes that are trained together, `mapping.window`.
    pub window: usize,
    /// Anchors have features and chunks decoders, `mapping.decoder`.
    pub learned_decoder: bool,
    /// Keyframes keep their depth, `mapping.loss_depth`.
    pub trains_depth: bool,
}

impl MappingPlan {
    /// What these settings ask for, for a camera of this width.
    pub fn of(mapper: &MapperSettings, camera_width_px: u32) -> Self {
        Self {
            resolution: mapper.resolution_for(camera_width_px),
            window: mapper.window,
            learned_decoder: mapper.learned_decoder,
            trains_depth: mapper.trains_depth(),
        }
    }
}

/// What the plan has to know beside the budget.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlanInput {
    /// Width of the camera's image, px.
    pub width: u32,
    /// Height of the camera's image, px.
    pub height: u32,
    /// Bytes of one frame as the capture process publishes it.
    pub frame_bytes: u64,
    /// Channels of the images that the map is trained on: 1 or 3.
    pub color_channels: u32,
    /// What the mapper is going to do.
    pub mapping: MappingPlan,
    /// What computes the map, and in whose memory.
    pub compute: ComputeMemory,
    /// Trained networks run beside the tracker.
    pub has_networks: bool,
    /// Loops are closed.
    pub has_loops: bool,
}

/// What computes the map, and in whose memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ComputeMemory {
    /// The CPU.
    Cpu,
    /// A device that uses the machine's memory: software, or part of the processor's chip.
    SharedDevice,
    /// A device with memory of its own.
    OwnDevice,
}

impl PlanInput {
    /// Pixels of the camera's image.
    pub fn pixels(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height)
    }

    /// Pixels of a training image.
    pub fn mapping_pixels(&self) -> u64 {
        let camera = self.mapping_camera();
        u64::from(camera.width) * u64::from(camera.height)
    }

    /// Size of the training images; its intrinsics mean nothing.
    fn mapping_camera(&self) -> Pinhole {
        let (width, height) = (self.width, self.height);
        let native = Pinhole { width, height, fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 };
        mapping_camera(&native, self.mapping.resolution)
    }
}

/// Bytes of one element of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Cost {
    /// In the machine's memory.
    pub host: u64,
    /// In the memory of a device that has its own.
    pub device: u64,
    /// Of these: in the arena of a device, wherever that lies.
    pub arena: u64,
}

/// Bytes of one element of `row`.
pub(super) fn cost_each(row: Row, budget: &Budget, input: &PlanInput) -> Cost {
    let splat = SplatSizes::of(budget, input);
    let of_backend = splat.cost_each(row, budget, input.compute);
    Cost { host: of_backend.host + host_bytes_each(row, budget, input), ..of_backend }
}

/// Bytes of one element of `row` without the splat backend.
fn host_bytes_each(row: Row, budget: &Budget, input: &PlanInput) -> u64 {
    let capacity = |row: Row| budget.capacity(row);
    let channels = u64::from(input.color_channels);
    let bytes = |n: usize| n as u64;
    match row {
        Row::IpcFrameSlots => {
            let slots = budget.frame_slots();
            slots.shared_bytes(input.frame_bytes).div_ceil(bytes(slots.n_slots()).max(1))
        }
        Row::TrackingGrayImages => input.pixels(),
        Row::TrackingPyramids => bytes(budget.tracker_capacities(input).bytes_per_pyramid()),
        Row::TrackingTracks => bytes(BYTES_PER_TRACK),
        Row::TrackingLandmarks => bytes(BYTES_PER_LANDMARK),
        Row::TrackingKeyframes => bytes((size_of::<KeyframeWindow>() + size_of::<ReducedSystem>()).div_ceil(WINDOW)),
        Row::TrackingFeatures => bytes(budget.descriptor_bytes(input)).div_ceil(bytes(capacity(Row::TrackingFeatures))),
        Row::TrackingDenseMatchers => bytes(budget.dense_capacities(input).bytes()),
        Row::TrackingSpeedReadings => bytes(size_of::<Speed>()),
        Row::PipelineKeyframeQueue => {
            input.frame_bytes
                + bytes(size_of::<FrameReport>() + capacity(Row::TrackingTracks) * size_of::<KeyframePoint>())
        }
        Row::PipelineLoopQueue
        | Row::LoopsPlaces
        | Row::LoopsKeyframes
        | Row::LoopsGraphNodes
        | Row::LoopsWorkspaces
            if !input.has_loops =>
        {
            0
        }
        Row::PipelineLoopQueue => bytes(loops::bytes_per_job(input.pixels(), capacity(Row::TrackingTracks))),
        Row::LoopsPlaces => bytes(loops::BYTES_PER_PLACE),
        Row::LoopsKeyframes => bytes(loops::BYTES_PER_KEYFRAME),
        Row::LoopsGraphNodes => {
            bytes(budget.loop_graph().bytes()).div_ceil(bytes(capacity(Row::LoopsGraphNodes)).max(1))
        }
        Row::LoopsWorkspaces => {
            bytes(loops::workspace_bytes(input.width as usize, input.height as usize, capacity(Row::LoopsPoints)))
        }
        Row::MapAnchors => bytes(mapper::BYTES_PER_ANCHOR),
        // Their sizes are part of the rows that they multiply.
        Row::MapGaussiansPerAnchor | Row::StorePageAnchors | Row::LoopsPoints => 0,
        Row::MapNewAnchors => bytes(mapper::bytes_per_new_anchor(capacity(Row::MapGaussiansPerAnchor))),
        Row::MapVoxels => bytes(mapper::BYTES_PER_VOXEL),
        Row::MapKeyframeImages => {
            let channels = input.color_channels as usize;
            bytes(mapper::bytes_per_image(&input.mapping_camera(), channels))
        }
        Row::MapKeyframeDepths if input.mapping.trains_depth => bytes(mapper::bytes_per_depth(&input.mapping_camera())),
        Row::MapKeyframeDepths => 0,
        Row::MapWorkspaces => {
            bytes(mapper::workspace_bytes(&input.mapping_camera(), capacity(Row::MapGaussiansPerAnchor)))
        }
        Row::MapKeyframes | Row::MapChunks => bytes(mapper::BYTES_PER_ROW),
        Row::MapPages => bytes(mapper::BYTES_PER_PAGE),
        // The splat backend's own.
        Row::SplatVisibleGaussians | Row::SplatRowEntries | Row::SplatPairs | Row::SplatViews => 0,
        Row::StorePageQueue | Row::StoreReturningPages => bytes(budget.store_capacity().page_bytes),
        Row::StoreImageQueue => input.pixels() * channels,
        Row::StoreKeyframeTable => {
            bytes(size_of::<StoredKeyframe>() + size_of::<PageLabel>() + PictureRule::bytes_per_place())
        }
        Row::TelemetryFrameRecords => bytes(size_of::<FrameReport>() + size_of::<StageTimes>()),
        Row::InferenceArena => u64::from(input.has_networks),
        Row::ProcessComputeDriver => u64::from(input.compute != ComputeMemory::Cpu),
        Row::ProcessCodeAndStacks | Row::ProcessCameraChild => 1,
    }
}

/// The splat backends' own plans.
struct SplatSizes {
    cpu: [MemoryRow; 10],
    copy: [MemoryRow; 4],
    capacities: Capacities,
}

impl SplatSizes {
    fn of(budget: &Budget, input: &PlanInput) -> Self {
        let capacities = budget.splat_capacities(input);
        Self { cpu: CpuBackend::memory_plan(&capacities), copy: HostCopy::memory_plan(&capacities), capacities }
    }

    /// A device backend has the CPU backend behind it where the row lies on both sides. A device without memory of its
    /// own gives that memory back before the CPU backend takes it: the plan holds whichever is larger.
    fn cost_each(&self, row: Row, budget: &Budget, compute: ComputeMemory) -> Cost {
        let names = splat_rows(row);
        let cpu: u64 = names.iter().map(|name| each(&self.cpu, name, row)).sum();
        let copy: u64 = names.iter().map(|name| each(&self.copy, name, row)).sum();
        let on_cpu = Cost { host: cpu, device: 0, arena: 0 };
        if compute == ComputeMemory::Cpu || names.is_empty() {
            return on_cpu;
        }
        let arena = arena_bytes_each(row, budget, &self.capacities);
        let has_substitute = budget.entry(row).location != Location::Device;
        match (compute, has_substitute) {
            (ComputeMemory::Cpu, _) => on_cpu,
            (ComputeMemory::SharedDevice, true) => {
                let cpu_bytes: u64 = self.cpu.iter().map(|part| part.bytes() as u64).sum();
                let larger = if cpu_bytes >= arena_bytes(&self.capacities) { cpu } else { arena };
                Cost { host: larger + copy, device: 0, arena }
            }
            (ComputeMemory::SharedDevice, false) => Cost { host: arena, device: 0, arena },
            (ComputeMemory::OwnDevice, true) => Cost { host: cpu + copy, device: arena, arena },
            (ComputeMemory::OwnDevice, false) => Cost { host: 0, device: arena, arena },
        }
    }
}

/// The rows of a splat backend's plan that a row of the budget pays for.
fn splat_rows(row: Row) -> &'static [&'static str] {
    match row {
        Row::MapAnchors => &["splat.anchors"],
        Row::MapKeyframes => &["splat.keyframe_rows"],
        Row::MapKeyframeImages => &["splat.exposure_slots"],
        Row::MapChunks => &["splat.chunk_rows"],
        Row::SplatVisibleGaussians => &["splat.visible_gaussians"],
        Row::SplatRowEntries => &["splat.row_entries"],
        Row::SplatPairs => &["splat.pairs"],
        Row::SplatViews => &["splat.image_pixels", "splat.training_pixels", "splat.chunk_gradients"],
        _ => &[],
    }
}

/// Bytes of one element; a view's are the bytes of all its pixels.
fn each(plan: &[MemoryRow], name: &str, row: Row) -> u64 {
    let part = plan.iter().find(|part| part.name == name);
    part.map_or(0, |part| if row == Row::SplatViews { part.bytes() as u64 } else { part.bytes_per_element as u64 })
}

/// Rows that pay for buffers of the arena, beside the view.
const ARENA_ROWS: [Row; 7] = [
    Row::MapAnchors,
    Row::MapKeyframes,
    Row::MapKeyframeImages,
    Row::MapChunks,
    Row::SplatVisibleGaussians,
    Row::SplatRowEntries,
    Row::SplatPairs,
];

/// The same capacities with one element of `row`.
fn with_one(row: Row, capacities: &Capacities) -> Capacities {
    let mut shrunk = *capacities;
    match row {
        Row::MapAnchors => shrunk.anchors = 1,
        Row::MapKeyframes => shrunk.keyframe_rows = 1,
        Row::MapKeyframeImages => shrunk.exposure_slots = 1,
        Row::MapChunks => shrunk.chunk_rows = 1,
        Row::SplatVisibleGaussians => shrunk.visible_gaussians = 1,
        Row::SplatRowEntries => shrunk.row_entries = 1,
        Row::SplatPairs => shrunk.pairs = 1,
        _ => {}
    }
    shrunk
}

/// Bytes of the arena for one element of `row`: what the arena would shrink by with one element instead of all, and the
/// rest of it for the view.
fn arena_bytes_each(row: Row, budget: &Budget, capacities: &Capacities) -> u64 {
    let all = arena_bytes(capacities);
    let share = |row: Row| {
        all.saturating_sub(arena_bytes(&with_one(row, capacities))).div_ceil(budget.entry(row).capacity.max(1))
    };
    if ARENA_ROWS.contains(&row) {
        return share(row);
    }
    let others: u64 = ARENA_ROWS.iter().map(|&of| share(of) * budget.entry(of).capacity).sum();
    all.saturating_sub(others)
}

/// The row of the budget behind a buffer of the arena: the one whose capacity it grows with.
pub fn row_behind_buffer(buffer: &str, capacities: &Capacities) -> Row {
    let bytes = |capacities: &Capacities| {
        buffer_plan(capacities).iter().find(|row| row.name == buffer).map_or(0, MemoryRow::bytes)
    };
    let grows = ARENA_ROWS.iter().min_by_key(|&&row| bytes(&with_one(row, capacities)));
    let is_meant = |row: &&Row| bytes(&with_one(**row, capacities)) < bytes(capacities);
    grows.filter(is_meant).copied().unwrap_or(Row::SplatViews)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn input(compute: ComputeMemory) -> PlanInput {
        PlanInput {
            width: 1241,
            height: 376,
            frame_bytes: 1241 * 376 * 3,
            color_channels: 3,
            mapping: MappingPlan { resolution: 0.5, window: 6, learned_decoder: true, trains_depth: true },
            compute,
            has_networks: false,
            has_loops: true,
        }
    }

    fn sum_of(compute: ComputeMemory, part: fn(&Cost) -> u64) -> u64 {
        let budget = Budget::builtin().expect("valid");
        let input = input(compute);
        let sizes = SplatSizes::of(&budget, &input);
        super::super::ROWS
            .iter()
            .map(|spec| part(&sizes.cost_each(spec.row, &budget, compute)) * budget.entry(spec.row).capacity)
            .sum()
    }

    fn bytes_of(rows: &[MemoryRow]) -> u64 {
        rows.iter().map(|part| part.bytes() as u64).sum()
    }

    #[test]
    fn every_row_of_the_splat_backends_is_in_the_plan() {
        let capacities = Budget::builtin().expect("valid").splat_capacities(&input(ComputeMemory::Cpu));
        let cpu = bytes_of(&CpuBackend::memory_plan(&capacities));
        let copy = bytes_of(&HostCopy::memory_plan(&capacities));
        let arena = arena_bytes(&capacities);
        assert_eq!(sum_of(ComputeMemory::Cpu, |cost| cost.host), cpu);
        assert_eq!(sum_of(ComputeMemory::Cpu, |cost| cost.device + cost.arena), 0);
        assert_eq!(sum_of(ComputeMemory::OwnDevice, |cost| cost.host), cpu + copy);
        assert!(sum_of(ComputeMemory::SharedDevice, |cost| cost.host) >= cpu.max(arena) + copy);
        for compute in [ComputeMemory::SharedDevice, ComputeMemory::OwnDevice] {
            let planned = sum_of(compute, |cost| cost.arena);
            // Shares are rounded up to bytes per element.
            assert!((arena..arena + (4 << 20)).contains(&planned), "{planned} for an arena of {arena}");
        }
    }

    #[test]
    fn a_buffer_leads_to_its_row() {
        let capacities = Budget::builtin().expect("valid").splat_capacities(&input(ComputeMemory::Cpu));
        let check = |buffer: &str, row: Row| assert_eq!(row_behind_buffer(buffer, &capacities), row, "{buffer}");
        check("splat.device.params", Row::MapAnchors);
        check("splat.device.pairs", Row::SplatPairs);
        check("splat.device.entries", Row::SplatRowEntries);
        check("splat.device.splats", Row::SplatVisibleGaussians);
        check("splat.device.planes", Row::SplatViews);
        check("no such buffer", Row::SplatViews);
    }
}
