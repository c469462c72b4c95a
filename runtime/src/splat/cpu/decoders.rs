//! The chunks' decoders, and what the optimizer remembers about them.

use crate::splat::{Capacities, DecoderShape};

/// One decoder per chunk row, or none at all.
pub struct Decoders {
    /// Where its parts begin.
    pub shape: DecoderShape,
    rows: Vec<Decoder>,
}

/// A decoder with its moments.
pub struct Decoder {
    /// The numbers in the layout of [`kilogs_core::map::decoder`].
    pub weights: Vec<f32>,
    /// Adam's running mean of the gradient.
    pub first: Vec<f32>,
    /// Of its square.
    pub second: Vec<f32>,
    /// Steps taken, saturating.
    pub steps: u32,
}

/// Bytes of one chunk row.
pub const fn decoder_row_bytes(gaussians_per_anchor: usize) -> usize {
    size_of::<Decoder>() + 3 * DecoderShape::new(gaussians_per_anchor).len() * size_of::<f32>()
}

impl Decoders {
    /// Decoders that add nothing and cannot learn before they are written.
    pub fn new(capacities: &Capacities) -> Self {
        let shape = DecoderShape::new(capacities.gaussians_per_anchor);
        let n_rows = if capacities.learned_decoder { capacities.chunk_rows } else { 0 };
        let zeros = || vec![0.0; shape.len()];
        let row = || Decoder { weights: zeros(), first: zeros(), second: zeros(), steps: 0 };
        Self { shape, rows: (0..n_rows).map(|_| row()).collect() }
    }

    /// Replaces a decoder and forgets its moments; false when row or length are wrong, or a number not usable.
    pub fn write(&mut self, chunk_row: u16, weights: &[f32]) -> bool {
        let fits = weights.len() == self.shape.len() && weights.iter().all(|v| v.is_finite());
        let Some(decoder) = self.rows.get_mut(usize::from(chunk_row)).filter(|_| fits) else { return false };
        decoder.weights.copy_from_slice(weights);
        decoder.first.fill(0.0);
        decoder.second.fill(0.0);
        decoder.steps = 0;
        true
    }

    /// Decoder of a chunk row.
    pub fn row(&self, chunk_row: u16) -> Option<&Decoder> {
        self.rows.get(usize::from(chunk_row))
    }
}
