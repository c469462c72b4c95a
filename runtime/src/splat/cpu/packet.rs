//! Sixteen Gaussians turned sideways: one row per number, one column per Gaussian, so that SIMD lanes are Gaussians.

use super::anchors::FixedNumbers;
use super::cull::KeyframeNumbers;
use super::decode::{AnchorLanes, N_PARAMS};
use super::lane::{Wide, each};
use super::project::CameraFromKeyframe;
use pulp::Simd;
use zerocopy::IntoBytes;

/// Gaussians of a packet: the widest vector there is.
pub const PACKET: usize = 16;

/// One number of each Gaussian of a packet.
#[derive(Clone, Copy)]
#[repr(align(64))]
pub struct Row(pub [f32; PACKET]);

/// Zeros.
pub const ZERO_ROW: Row = Row([0.0; PACKET]);

impl Row {
    /// The lanes from `first` on.
    #[inline(always)]
    pub fn load<S: Simd>(&self, simd: S, first: usize) -> Wide<S> {
        Wide::load(simd, &self.0[first..])
    }

    /// Stores the lanes from `first` on.
    #[inline(always)]
    pub fn store<S: Simd>(&mut self, first: usize, value: Wide<S>) {
        value.store(&mut self.0[first..]);
    }
}

/// What decoding and projection read, for [`PACKET`] Gaussians.
pub struct Packet {
    /// Trained numbers.
    pub params: [Row; N_PARAMS],
    position: [Row; 3],
    extent: [Row; 3],
    placement: [Row; 12],
}

/// The same for one vector of lanes.
pub struct PacketLanes<S: Simd> {
    /// Trained numbers.
    pub params: [Wide<S>; N_PARAMS],
    /// What the anchor contributes.
    pub anchor: AnchorLanes<Wide<S>>,
    /// Camera from the anchor's keyframe.
    pub placement: CameraFromKeyframe<Wide<S>>,
}

impl Packet {
    /// Zeros.
    pub fn new() -> Self {
        Self { params: [ZERO_ROW; N_PARAMS], position: [ZERO_ROW; 3], extent: [ZERO_ROW; 3], placement: [ZERO_ROW; 12] }
    }

    /// Fetches the Gaussians `slot * k + i`, of which `params` begins at `first_id`; columns beyond them keep what they had.
    #[inline(always)]
    pub fn gather(
        &mut self,
        anchors: &FixedNumbers<'_>,
        params: &[[f32; N_PARAMS]],
        keyframes: &[KeyframeNumbers],
        ids: &[u32],
        first_id: usize,
    ) {
        for (lane, &id) in ids.iter().take(PACKET).enumerate() {
            let id = id as usize;
            let slot = id / anchors.k;
            let header = &anchors.headers[slot];
            for (row, &value) in self.params.iter_mut().zip(&params[id - first_id]) {
                row.0[lane] = value;
            }
            for (row, &value) in self.placement.iter_mut().zip(&keyframes[header.keyframe_row as usize]) {
                row.0[lane] = value;
            }
            for a in 0..3 {
                self.position[a].0[lane] = header.position_in_keyframe_m[a];
                self.extent[a].0[lane] = anchors.extents_m[slot][a];
            }
        }
    }

    /// Fetches only the trained numbers.
    #[inline(always)]
    pub fn gather_params(&mut self, params: &[[f32; N_PARAMS]], ids: &[u32], first_id: usize) {
        for (lane, &id) in ids.iter().take(PACKET).enumerate() {
            for (row, &value) in self.params.iter_mut().zip(&params[id as usize - first_id]) {
                row.0[lane] = value;
            }
        }
    }

    /// The lanes from `first` on.
    #[inline(always)]
    pub fn lanes<S: Simd>(&self, simd: S, first: usize) -> PacketLanes<S> {
        let mut params = [Wide::splat(simd, 0.0); N_PARAMS];
        for i in 0..N_PARAMS {
            params[i] = self.params[i].load(simd, first);
        }
        PacketLanes {
            params,
            anchor: AnchorLanes {
                position: each!(i in 3 => self.position[i].load(simd, first)),
                extent: each!(i in 3 => self.extent[i].load(simd, first)),
            },
            placement: CameraFromKeyframe {
                linear: each!(r in 3 => each!(c in 3 => self.placement[3 * r + c].load(simd, first))),
                translation: each!(i in 3 => self.placement[9 + i].load(simd, first)),
            },
        }
    }
}

/// The Gaussians' numbers as arrays.
pub fn as_arrays(params: &[crate::splat::GaussianParams]) -> &[[f32; N_PARAMS]] {
    // Both are `N_PARAMS` consecutive f32.
    zerocopy::FromBytes::ref_from_bytes(params.as_bytes()).unwrap_or(&[])
}

/// The Gaussians' numbers as arrays.
pub fn as_arrays_mut(params: &mut [crate::splat::GaussianParams]) -> &mut [[f32; N_PARAMS]] {
    zerocopy::FromBytes::mut_from_bytes(params.as_mut_bytes()).unwrap_or_default()
}

/// The Gaussians' numbers one after the other.
pub fn as_numbers(params: &[crate::splat::GaussianParams]) -> &[f32] {
    as_arrays(params).as_flattened()
}

/// The Gaussians' numbers one after the other.
pub fn as_numbers_mut(params: &mut [crate::splat::GaussianParams]) -> &mut [f32] {
    as_arrays_mut(params).as_flattened_mut()
}

/// The Gaussians of numbers that follow one another.
pub fn as_gaussians(numbers: &[f32]) -> &[crate::splat::GaussianParams] {
    zerocopy::FromBytes::ref_from_bytes(numbers.as_bytes()).unwrap_or(&[])
}
