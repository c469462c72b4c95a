//! What a device runs, as data: named buffers planned from the capacities, and stages in the order of the dispatches.
//!
//! Stages are static: which buffers a kernel is bound to never changes, so an executor prepares everything when it
//! opens and only evaluates workgroup counts per run. Every stage sees all writes of the stages before it.

use super::kernel_constants::{BLOCK_PX, GROUP, N_PARAMS, TILE_PX};
use super::kernels::Kernel;
use super::layout::{Counters, DeviceAnchor, IndirectGroups, KeyframeBlock, ViewBlock};
use super::{Capacities, MemoryRow};

/// Declares the buffers: the enum, its names and how large each is.
macro_rules! buffers {
    ($($(#[$doc:meta])* $buffer:ident = $name:literal, $elements:expr, $bytes:expr;)+) => {
        /// A device buffer; its number is its row of [`buffer_plan`].
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Buffer {
            $($(#[$doc])* $buffer,)+
        }

        impl Buffer {
            /// All buffers in the order of their numbers.
            pub const ALL: &'static [Self] = &[$(Self::$buffer),+];
        }

        /// Name and size of every buffer, in the order of [`Buffer::ALL`]; all sizes are multiples of 16 bytes.
        pub fn buffer_plan(capacities: &Capacities) -> [MemoryRow; Buffer::ALL.len()] {
            let sizes = Sizes::of(capacities);
            [$({
                let elements: fn(&Sizes) -> usize = $elements;
                MemoryRow { name: $name, elements: padded(elements(&sizes), $bytes), bytes_per_element: $bytes }
            }),+]
        }
    };
}

buffers! {
    /// The uniform block of every kernel.
    View = "splat.device.view", |_| 1, size_of::<ViewBlock>();
    /// Counters of a run, cleared by the host before it.
    Counters = "splat.device.counters", |_| 1, size_of::<Counters>();
    /// Workgroup counts that kernels find out.
    Dispatch = "splat.device.dispatch", |_| 1, size_of::<IndirectGroups>();
    /// What of an anchor never changes by training.
    Anchors = "splat.device.anchors", |s| s.slots, size_of::<DeviceAnchor>();
    /// Trained numbers, `k` Gaussians per slot.
    Params = "splat.device.params", |s| s.gaussians * N_PARAMS as usize, 4;
    /// Camera from each keyframe row.
    Keyframes = "splat.device.keyframes", |s| s.keyframe_rows, size_of::<KeyframeBlock>();
    /// Which Gaussians of each slot may be in view, one bit each.
    VisibleBits = "splat.device.visible_bits", |s| s.slots, 4;
    /// Candidates of each workgroup of `cull`, then where they begin.
    GroupTotals = "splat.device.group_totals", |s| s.slots.div_ceil(GROUP as usize), 4;
}

/// What sizes follow from.
struct Sizes {
    slots: usize,
    gaussians: usize,
    keyframe_rows: usize,
}

impl Sizes {
    fn of(capacities: &Capacities) -> Self {
        Self {
            slots: capacities.anchors,
            gaussians: capacities.anchors * capacities.gaussians_per_anchor,
            keyframe_rows: capacities.keyframe_rows,
        }
    }
}

/// Elements so that the bytes are a multiple of 16.
fn padded(elements: usize, bytes: usize) -> usize {
    let unit = (16 / bytes.clamp(1, 16)).max(1);
    elements.max(1).next_multiple_of(unit)
}

impl Buffer {
    /// Name of the buffer in budgets and messages.
    pub fn name(self, plan: &[MemoryRow; Self::ALL.len()]) -> &'static str {
        plan[self as usize].name
    }
}

/// One dispatch.
#[derive(Clone, Copy, Debug)]
pub struct Stage {
    /// What runs.
    pub kernel: Kernel,
    /// What its storage bindings 1, 2, ... are; [`Buffer::View`] is always binding 0.
    pub buffers: &'static [Buffer],
    /// Over what it runs.
    pub extent: Extent,
}

/// What a stage has an invocation or a workgroup for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extent {
    /// This many workgroups.
    Groups(u32),
    /// An invocation per slot that may be in use.
    Slots,
    /// An invocation per pixel.
    Pixels,
    /// An invocation per block of pixels, 16 consecutive ones to a tile.
    Blocks,
    /// A workgroup per tile.
    Tiles,
    /// A workgroup per row of tiles.
    TileRows,
    /// Three words of [`Buffer::Dispatch`] from this byte on; that buffer is then not bound to the kernel.
    Indirect(u32),
}

/// Size of a run's work.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WorkSize {
    /// Slots below this number may be in use.
    pub slots: u32,
    /// Width of the picture, px.
    pub width_px: u32,
    /// Height of the picture, px.
    pub height_px: u32,
}

impl WorkSize {
    /// Columns and rows of tiles.
    pub fn tiles(&self) -> [u32; 2] {
        [self.width_px.div_ceil(TILE_PX), self.height_px.div_ceil(TILE_PX)]
    }
}

/// How many workgroups a stage has; always along x.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Workgroups {
    /// Known to the host; 0 means that the dispatch is left out.
    Direct(u32),
    /// Three words of [`Buffer::Dispatch`] from this byte on.
    Indirect(u32),
}

impl Stage {
    /// Workgroups for a run.
    pub fn workgroups(&self, work: &WorkSize) -> Workgroups {
        let size = self.kernel.spec().workgroup_size;
        let [columns, rows] = work.tiles();
        let blocks_per_tile = (TILE_PX / BLOCK_PX) * (TILE_PX / BLOCK_PX);
        Workgroups::Direct(match self.extent {
            Extent::Groups(n) => n,
            Extent::Slots => work.slots.div_ceil(size),
            Extent::Pixels => (work.width_px * work.height_px).div_ceil(size),
            Extent::Blocks => (columns * rows * blocks_per_tile).div_ceil(size),
            Extent::Tiles => columns * rows,
            Extent::TileRows => rows,
            Extent::Indirect(offset_bytes) => return Workgroups::Indirect(offset_bytes),
        })
    }
}

/// A part of a run; an executor runs several in one submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// From anchors to the picture.
    Draw,
}

impl Part {
    /// All parts in the order of their numbers.
    pub const ALL: &'static [Self] = &[Self::Draw];

    /// The part's dispatches in order.
    pub fn stages(self) -> &'static [Stage] {
        match self {
            Self::Draw => DRAW,
        }
    }
}

const fn stage(kernel: Kernel, extent: Extent, buffers: &'static [Buffer]) -> Stage {
    Stage { kernel, buffers, extent }
}

use Buffer as B;

/// From anchors to the picture.
const DRAW: &[Stage] = &[
    stage(Kernel::Cull, Extent::Slots, &[B::Anchors, B::Params, B::Keyframes, B::VisibleBits, B::GroupTotals]),
    stage(Kernel::ScanCandidates, Extent::Groups(1), &[B::GroupTotals, B::Counters, B::Dispatch]),
];
