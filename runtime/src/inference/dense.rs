//! Coarse features of whole images, matched by likeness alone: XFeat*, for frames where keypoints have failed.
//!
//! The features lie on a grid of 8 px at two scales. Mutual nearest neighbours are pairs, and a small network says from
//! the two descriptors how far apart within a cell they are.
//!
//! # Source
//! Potje et al., CVPR 2024, sec. 3.3, with the image at half and at full size in place of 0.6 and 1.3.

use super::ModelError;
use super::features::{CELL_PX, sizes_for};
use super::manifest::{Manifest, Role};
use super::nearest;
use super::network::Network;
use super::picture::{Fit, Picture};
use super::two_views::FindAndMatch;
use kilogs_core::correspondence::PixelMatch;
use tract_onnx::prelude::tvec;

/// Features of an image at most. The authors' 4096 and more; ours bounds the time of the comparison.
const N_FEATURES: usize = 4096;
/// Share of them at the finer scale. The authors'.
const FINE_SHARE: f64 = 0.8;
/// Share of the best of the 64 offsets below which a pair is not believed. The authors'.
const MIN_OFFSET_SHARE: f32 = 0.25;
/// Sharpens the shares of the offsets. The authors'.
const OFFSET_SHARPNESS: f32 = 3.0;
const N_OFFSETS: usize = CELL_PX * CELL_PX;
const N_CHANNELS: usize = 64;

/// A network for each scale, and one for the offsets.
#[derive(Debug)]
pub(super) struct CoarseToFine {
    /// From the coarser to the finer scale.
    scales: Vec<Network>,
    fine: Network,
}

/// Features on the grids of all scales.
#[derive(Debug, Default)]
pub(super) struct CoarseFeatures {
    /// First pixel of the cell, in the network's input; which scale it is of.
    places: Vec<([f32; 2], Fit)>,
    /// A unit vector for each.
    descriptors: Vec<f32>,
}

impl CoarseToFine {
    /// The networks for images of this size: the one that holds it, and the next smaller.
    pub(super) fn load(
        manifest: &Manifest,
        (image, max_width_px): ((usize, usize), usize),
    ) -> Result<Self, ModelError> {
        let rows = sizes_for(manifest, Role::XfeatFeatures, image, max_width_px);
        let rows = &rows[rows.len().saturating_sub(2)..];
        manifest.first(Role::XfeatFeatures)?;
        let scales: Result<_, _> = rows.iter().map(|row| Network::load(manifest, row)).collect();
        let fine = Network::load(manifest, manifest.first(Role::XfeatFine)?)?;
        Ok(Self { scales: scales?, fine })
    }
}

impl FindAndMatch for CoarseToFine {
    type Found = CoarseFeatures;

    fn find(&self, picture: &Picture) -> Result<CoarseFeatures, ModelError> {
        let mut found = CoarseFeatures::default();
        for (idx, network) in self.scales.iter().enumerate() {
            let is_finest = idx + 1 == self.scales.len();
            let share = if self.scales.len() == 1 {
                1.0
            } else if is_finest {
                FINE_SHARE
            } else {
                1.0 - FINE_SHARE
            };
            let fit = Fit::new((picture.width, picture.height), network.row().image_size());
            let image = network.input(0, &fit.planes(picture, &[(0.0, 1.0); 3]))?;
            let outputs = network.run(tvec![image])?;
            let (maps, reliability) = (network.numbers(&outputs[0])?, network.numbers(&outputs[2])?);
            found.add_best(fit, maps, reliability, (N_FEATURES as f64 * share) as usize);
        }
        Ok(found)
    }

    fn match_found(
        &self,
        keyframe: &CoarseFeatures,
        current: &CoarseFeatures,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError> {
        let pairs = nearest::mutual(&keyframe.descriptors, &current.descriptors, N_CHANNELS);
        let at_once = self.fine.row().inputs[0].shape[0];
        let mut rows = vec![0.0; at_once * 2 * N_CHANNELS];
        for pairs in pairs.chunks(at_once) {
            for (row, &(i, j)) in rows.chunks_mut(2 * N_CHANNELS).zip(pairs) {
                let (first, second) = row.split_at_mut(N_CHANNELS);
                first.copy_from_slice(&keyframe.descriptors[i * N_CHANNELS..(i + 1) * N_CHANNELS]);
                second.copy_from_slice(&current.descriptors[j * N_CHANNELS..(j + 1) * N_CHANNELS]);
            }
            let outputs = self.fine.run(tvec![self.fine.input(0, &rows)?])?;
            let logits = self.fine.numbers(&outputs[0])?;
            for (&(i, j), logits) in pairs.iter().zip(logits.chunks(N_OFFSETS)) {
                let (offset_px, confidence) = mean_offset(logits);
                if confidence > MIN_OFFSET_SHARE {
                    let keyframe_px = keyframe.camera_px(i, offset_px);
                    matches.push(PixelMatch { keyframe_px, current_px: current.camera_px(j, [0.0; 2]), confidence });
                }
            }
        }
        Ok(())
    }
}

impl CoarseFeatures {
    /// Adds the `n` most reliable cells that show the image, in a fixed order.
    fn add_best(&mut self, fit: Fit, maps: &[f32], reliability: &[f32], n: usize) {
        let width = fit.input.0 / CELL_PX;
        let shows_image = |cell: &usize| {
            let (x, y) = (cell % width * CELL_PX, cell / width * CELL_PX);
            x + CELL_PX / 2 < fit.content.0 && y + CELL_PX / 2 < fit.content.1
        };
        let mut cells: Vec<_> = (0..reliability.len()).filter(shows_image).collect();
        cells.sort_by(|&a, &b| reliability[b].total_cmp(&reliability[a]));
        for cell in cells.into_iter().take(n) {
            self.places.push(([(cell % width * CELL_PX) as f32, (cell / width * CELL_PX) as f32], fit));
            self.descriptors.extend((0..N_CHANNELS).map(|channel| maps[channel * reliability.len() + cell]));
        }
    }

    fn camera_px(&self, idx: usize, offset_px: [f32; 2]) -> [f32; 2] {
        let ([x, y], fit) = self.places[idx];
        fit.camera_px([x + offset_px[0] + 0.5, y + offset_px[1] + 0.5])
    }
}

/// Mean of the 64 offsets, which are 8 x 8 px about the middle, and the largest share.
fn mean_offset(logits: &[f32]) -> ([f32; 2], f32) {
    let largest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (mut sum, mut offset_px) = (0.0, [0.0; 2]);
    for (idx, logit) in logits.iter().enumerate() {
        let share = (OFFSET_SHARPNESS * (logit - largest)).exp();
        let from_middle = |place: usize| place as f32 - (CELL_PX / 2) as f32;
        sum += share;
        offset_px[0] += share * from_middle(idx % CELL_PX);
        offset_px[1] += share * from_middle(idx / CELL_PX);
    }
    (offset_px.map(|o| o / sum), 1.0 / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_are_about_the_middle() {
        let check = |at: usize, expected: [f32; 2]| {
            let mut logits = vec![0.0; N_OFFSETS];
            logits[at] = 20.0;
            let (offset_px, confidence) = mean_offset(&logits);
            assert!(confidence > 0.99 && (0..2).all(|c| (offset_px[c] - expected[c]).abs() < 1e-3), "{offset_px:?}");
        };
        check(0, [-4.0, -4.0]);
        check(4 * 8 + 4, [0.0, 0.0]);
        check(6 * 8 + 5, [1.0, 2.0]);
        assert!(mean_offset(&[1.0; N_OFFSETS]).1 < 0.02, "no offset stands out");
    }
}
