//! The chunks' decoders: how they begin, which one learns, and what one makes of an anchor.

use super::capacity::MapperCapacity;
use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use crate::splat::{AnchorFeature, DecoderShape};
use kilogs_core::map::AnchorHeader;
use kilogs_core::map::decoder::{fill_fresh_decoder, residual_at_spawn};
use kilogs_core::store::DecoderParams;

/// Working memory for the decoder of one chunk at a time; the decoders themselves are in the splat backend.
#[derive(Debug)]
pub struct ChunkDecoders {
    shape: DecoderShape,
    /// Empty when nothing is learned.
    weights: Box<[f32]>,
    residual: Box<[f32]>,
    learning_chunk: Option<u32>,
}

impl ChunkDecoders {
    /// Memory for decoders of these capacities.
    pub fn new(capacity: &MapperCapacity, is_learned: bool) -> Self {
        let shape = DecoderShape::new(capacity.gaussians_per_anchor);
        let only_if_learned = |n: usize| if is_learned { n } else { 0 };
        Self {
            shape,
            weights: vec![0.0; only_if_learned(shape.len())].into(),
            residual: vec![0.0; only_if_learned(shape.outputs)].into(),
            learning_chunk: None,
        }
    }

    /// Residual of an anchor, by the weights that were read last, seen from the keyframe that spawned it; empty when
    /// nothing is learned.
    pub fn residual_at_spawn(&mut self, header: &AnchorHeader, feature: &AnchorFeature) -> &[f32] {
        if !self.weights.is_empty() {
            let position_m = header.position_in_keyframe_m;
            residual_at_spawn(self.shape, &self.weights, feature, position_m, &mut self.residual);
        }
        &self.residual
    }

    /// Whether chunks have decoders that are learned.
    pub fn is_learned(&self) -> bool {
        !self.weights.is_empty()
    }

    /// Takes a stored decoder as the weights that were read last; a chunk without one gets one that adds nothing. False
    /// when it is not of the kind that the backend has.
    pub fn take(&mut self, stored: DecoderParams<'_>) -> bool {
        if self.is_learned() && stored.is_residual() {
            return stored.read_residual(&mut self.weights);
        }
        self.weights.fill(0.0);
        !stored.is_residual()
    }

    /// The chunk whose decoder the next chunk begins with.
    pub fn go_on_after(&mut self, chunk: u32) {
        self.learning_chunk = Some(chunk);
    }

    /// The weights that were read last.
    pub fn weights(&self) -> &[f32] {
        &self.weights
    }

    /// The weights that were read last, as they are stored.
    pub fn stored(&self) -> DecoderParams<'_> {
        if self.weights.is_empty() { DecoderParams::EXPLICIT } else { DecoderParams::residual(&self.weights) }
    }
}

impl Mapper {
    /// Gives the chunk of a keyframe a decoder when it is the first of its chunk: that of the chunk before, which is
    /// frozen from now on, or a fresh one.
    pub(super) fn begin_decoder(&mut self, ordinal: u32) {
        let chunk = ordinal / CHUNK_KEYFRAMES;
        let previous = self.decoders.learning_chunk.replace(chunk);
        if self.decoders.weights.is_empty() || previous == Some(chunk) {
            return;
        }
        let is_known = previous.is_some_and(|previous| self.read_decoder(previous));
        if !is_known {
            let ChunkDecoders { shape, weights, .. } = &mut self.decoders;
            fill_fresh_decoder(*shape, self.settings.seed, chunk, weights);
        }
        if let Some(row) = self.row_of_chunk(chunk) {
            self.backend.write_decoder(row, &self.decoders.weights);
        }
    }

    /// Gives every chunk in memory the decoder that learns, when all chunks share one.
    pub(super) fn share_decoder(&mut self) {
        let learning = self.decoders.learning_chunk.filter(|_| self.settings.shared_decoder);
        if !learning.is_some_and(|chunk| self.read_decoder(chunk)) {
            return;
        }
        let chunk_rows = &self.paging.chunk_rows;
        let others =
            chunk_rows.ids().filter(|&chunk| Some(chunk) != learning).filter_map(|chunk| chunk_rows.row(chunk));
        for row in others.filter_map(|row| u16::try_from(row).ok()) {
            self.backend.write_decoder(row, &self.decoders.weights);
        }
    }

    /// Row of the decoder that learns.
    pub(super) fn learning_row(&self) -> Option<u16> {
        self.decoders.learning_chunk.and_then(|chunk| self.row_of_chunk(chunk))
    }

    /// Fetches a chunk's decoder; false when nothing is learned.
    pub(super) fn read_decoder(&mut self, chunk: u32) -> bool {
        let Some(row) = self.row_of_chunk(chunk) else { return false };
        !self.decoders.weights.is_empty() && self.backend.read_decoder(row, &mut self.decoders.weights)
    }
}
