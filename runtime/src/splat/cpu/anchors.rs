//! The trained numbers, and what the optimizer remembers about them.

use super::decode::N_PARAMS;
use crate::splat::{AnchorHeader, Capacities, GaussianParams};
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

/// Adam's running means of one Gaussian.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct Moments {
    /// Of the gradient.
    pub first: [f32; N_PARAMS],
    /// Of its square.
    pub second: [f32; N_PARAMS],
}

/// All anchor slots.
pub struct Anchors {
    /// Gaussians per slot.
    pub k: usize,
    /// What never changes by training; `n_gaussians` is 0 in slots that are not in use.
    pub headers: Vec<AnchorHeader>,
    /// `exp(log_extent)`, m.
    pub extents_m: Vec<[f32; 3]>,
    /// `k` Gaussians per slot.
    pub params: Vec<GaussianParams>,
    /// `k` Gaussians per slot.
    pub moments: Vec<Moments>,
    /// Steps that each Gaussian has taken, saturating.
    pub steps: Vec<u16>,
    /// Slots below this number may be in use.
    pub slots_end: usize,
}

/// What training reads of the anchors and never changes.
#[derive(Clone, Copy)]
pub struct FixedNumbers<'a> {
    /// One per slot.
    pub headers: &'a [AnchorHeader],
    /// One per slot, m.
    pub extents_m: &'a [[f32; 3]],
    /// Gaussians per slot.
    pub k: usize,
}

/// Bytes of one slot with `k` Gaussians.
pub const fn slot_bytes(k: usize) -> usize {
    size_of::<AnchorHeader>()
        + size_of::<[f32; 3]>()
        + k * (size_of::<GaussianParams>() + size_of::<Moments>() + size_of::<u16>())
}

impl Anchors {
    /// Empty slots.
    pub fn new(capacities: &Capacities) -> Self {
        let (n, k) = (capacities.anchors, capacities.gaussians_per_anchor);
        Self {
            k,
            headers: vec![FromZeros::new_zeroed(); n],
            extents_m: vec![[0.0; 3]; n],
            params: vec![FromZeros::new_zeroed(); n * k],
            moments: vec![FromZeros::new_zeroed(); n * k],
            steps: vec![0; n * k],
            slots_end: 0,
        }
    }

    /// What training reads.
    pub fn fixed(&self) -> FixedNumbers<'_> {
        FixedNumbers { headers: &self.headers, extents_m: &self.extents_m, k: self.k }
    }

    /// What training reads, and what it changes: numbers, moments, steps.
    pub fn split(&mut self) -> (FixedNumbers<'_>, &mut [GaussianParams], &mut [Moments], &mut [u16]) {
        let fixed = FixedNumbers { headers: &self.headers, extents_m: &self.extents_m, k: self.k };
        (fixed, &mut self.params, &mut self.moments, &mut self.steps)
    }

    /// Fills a slot and forgets its moments. False, and nothing written, when a number is not usable.
    pub fn write(&mut self, slot: u32, header: &AnchorHeader, params: &[GaussianParams], keyframe_rows: usize) -> bool {
        let slot = slot as usize;
        let n = usize::from(header.n_gaussians);
        let used = params.get(..n).unwrap_or_default();
        let numbers = [header.position_in_keyframe_m, header.log_extent];
        let usable = slot < self.headers.len()
            && n <= self.k
            && params.len() == self.k
            && (header.keyframe_row as usize) < keyframe_rows
            && numbers.as_flattened().iter().all(|v| v.is_finite())
            && used.as_bytes().chunks_exact(4).all(is_finite_f32);
        if !usable {
            return false;
        }
        self.headers[slot] = *header;
        self.extents_m[slot] = header.log_extent.map(f32::exp);
        let range = slot * self.k..(slot + 1) * self.k;
        self.params[range.clone()].copy_from_slice(params);
        self.moments[range.clone()].fill(FromZeros::new_zeroed());
        self.steps[range].fill(0);
        self.slots_end = self.slots_end.max(slot + 1);
        true
    }

    /// Reads a slot; false when it is out of range or the length is wrong.
    pub fn read(&self, slot: u32, header: &mut AnchorHeader, params: &mut [GaussianParams]) -> bool {
        let slot = slot as usize;
        let Some(found) = self.headers.get(slot).filter(|_| params.len() == self.k) else { return false };
        *header = *found;
        params.copy_from_slice(&self.params[slot * self.k..(slot + 1) * self.k]);
        true
    }

    /// Frees a slot; false when it is out of range.
    pub fn retire(&mut self, slot: u32) -> bool {
        let Some(header) = self.headers.get_mut(slot as usize) else { return false };
        header.n_gaussians = 0;
        while self.slots_end > 0 && self.headers[self.slots_end - 1].n_gaussians == 0 {
            self.slots_end -= 1;
        }
        true
    }
}

fn is_finite_f32(bytes: &[u8]) -> bool {
    f32::read_from_bytes(bytes).is_ok_and(f32::is_finite)
}
