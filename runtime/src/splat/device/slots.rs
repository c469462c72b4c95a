//! What the host keeps of the anchor slots: everything that training never changes.

use crate::splat::layout::DeviceAnchor;
use crate::splat::{AnchorHeader, Capacities, GaussianParams};
use zerocopy::{FromZeros, IntoBytes};

/// Headers of all slots.
pub struct Slots {
    headers: Vec<AnchorHeader>,
    /// Slots below this number may be in use.
    end: usize,
}

impl Slots {
    /// Empty slots.
    pub fn new(capacities: &Capacities) -> Self {
        Self { headers: vec![FromZeros::new_zeroed(); capacities.anchors], end: 0 }
    }

    /// Slots below this number may be in use.
    pub fn end(&self) -> usize {
        self.end
    }

    /// Header of a slot.
    pub fn header(&self, slot: u32) -> Option<&AnchorHeader> {
        self.headers.get(slot as usize)
    }

    /// Fills a slot; `None`, and nothing written, when a number is not usable.
    pub fn write(
        &mut self,
        capacities: &Capacities,
        slot: u32,
        header: &AnchorHeader,
        params: &[GaussianParams],
    ) -> Option<DeviceAnchor> {
        let n = usize::from(header.n_gaussians);
        let used = params.get(..n)?;
        let numbers = [header.position_in_keyframe_m, header.log_extent];
        let usable = n <= capacities.gaussians_per_anchor
            && params.len() == capacities.gaussians_per_anchor
            && (header.keyframe_row as usize) < capacities.keyframe_rows
            && numbers.as_flattened().iter().all(|v| v.is_finite())
            && used.iter().all(is_finite);
        let found = self.headers.get_mut(slot as usize).filter(|_| usable)?;
        *found = *header;
        self.end = self.end.max(slot as usize + 1);
        Some(device_anchor(header))
    }

    /// Frees a slot; what the device must know, `None` when the slot is out of range.
    pub fn retire(&mut self, slot: u32) -> Option<DeviceAnchor> {
        let header = self.headers.get_mut(slot as usize)?;
        header.n_gaussians = 0;
        let anchor = device_anchor(header);
        while self.end > 0 && self.headers[self.end - 1].n_gaussians == 0 {
            self.end -= 1;
        }
        Some(anchor)
    }
}

fn is_finite(params: &GaussianParams) -> bool {
    params.as_bytes().as_chunks().0.iter().all(|&bytes| f32::from_le_bytes(bytes).is_finite())
}

fn device_anchor(header: &AnchorHeader) -> DeviceAnchor {
    let [position_x, position_y, position_z] = header.position_in_keyframe_m;
    let [extent_x, extent_y, extent_z] = header.log_extent.map(f32::exp);
    DeviceAnchor {
        position_x,
        position_y,
        position_z,
        keyframe_row: header.keyframe_row,
        extent_x,
        extent_y,
        extent_z,
        packed: u32::from(header.level) | (u32::from(header.n_gaussians) << 8) | (u32::from(header.chunk_row) << 16),
    }
}
