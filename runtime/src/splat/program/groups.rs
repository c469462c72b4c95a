//! Dispatches, and how many workgroups they have.

use super::{Buffer, Part, buffer_plan};
use crate::splat::Capacities;
use crate::splat::device::DeviceError;
use crate::splat::kernel_constants::{BLOCK_PX, TILE_PX};
use crate::splat::kernels::Kernel;

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

/// Refuses capacities that a device could not run: a dispatch has its workgroups in one row, and `most` is what the device
/// takes in one (65535 is all that devices promise).
///
/// # Errors
/// [`DeviceError::TooManyGroups`] names the buffer whose capacity asks for more.
pub fn check_groups(capacities: &Capacities, most: u32) -> Result<(), DeviceError> {
    let largest = WorkSize {
        slots: capacities.anchors as u32,
        width_px: capacities.image_width_px,
        height_px: capacities.image_height_px,
    };
    let mut stages = Part::ALL.iter().flat_map(|part| part.stages());
    let beyond = stages.find_map(|stage| {
        let groups = match stage.workgroups(&largest) {
            Workgroups::Direct(n) => n,
            Workgroups::Indirect(_) => {
                (capacities.visible_gaussians as u32).div_ceil(stage.kernel.spec().workgroup_size)
            }
        };
        (groups > most).then_some((stage.extent.sized_by(), groups))
    });
    match beyond {
        Some((buffer, groups)) => {
            Err(DeviceError::TooManyGroups { name: buffer.name(&buffer_plan(capacities)), groups, limit: most })
        }
        None => Ok(()),
    }
}

impl Extent {
    /// The buffer that grows with this extent.
    fn sized_by(self) -> Buffer {
        match self {
            Self::Groups(_) => Buffer::View,
            Self::Slots => Buffer::Anchors,
            Self::Pixels => Buffer::Planes,
            Self::Blocks | Self::Tiles => Buffer::TileStarts,
            Self::TileRows => Buffer::EntryStarts,
            Self::Indirect(_) => Buffer::Candidates,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(change: impl FnOnce(&mut Capacities), most: u32) -> Option<(&'static str, u32)> {
        let mut capacities = Capacities::for_map(1000, 4, 64, 48);
        change(&mut capacities);
        match check_groups(&capacities, most) {
            Ok(()) => None,
            Err(DeviceError::TooManyGroups { name, groups, limit }) => {
                assert_eq!(limit, most);
                Some((name, groups))
            }
            Err(other) => panic!("{other}"),
        }
    }

    #[test]
    fn what_no_dispatch_can_hold_is_refused_by_the_row_that_asks_for_it() {
        let most = 65535;
        let rows = 256 * most as usize;
        assert_eq!(refused(|_| (), most), None);
        assert_eq!(refused(|c| c.anchors = rows, most), None);
        assert_eq!(refused(|c| c.anchors = rows + 1, most), Some(("splat.device.anchors", most + 1)));
        assert_eq!(refused(|c| c.visible_gaussians = rows, most), None);
        assert_eq!(refused(|c| c.visible_gaussians = rows + 1, most), Some(("splat.device.candidates", most + 1)));
        let largest = |c: &mut Capacities| (c.image_width_px, c.image_height_px) = (4096, 4096);
        assert_eq!(refused(largest, most), Some(("splat.device.tile_starts", most + 1)));
        assert_eq!(refused(largest, most + 1), None, "a device that takes more");
        assert_eq!(refused(|c| (c.image_width_px, c.image_height_px) = (4096, 4080), most), None);
    }
}
