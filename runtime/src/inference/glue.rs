//! Two sets of features to matches: LightGlue and its lighter sister.

use super::ModelError;
use super::features::Features;
use super::manifest::{Manifest, Role};
use super::network::Network;
use kilogs_core::correspondence::PixelMatch;
use tract_onnx::prelude::{TValue, tvec};

/// Probability below which two features are not the same point. The authors' filter threshold.
const MIN_PROBABILITY: f32 = 0.1;

/// A network that matches features.
#[derive(Debug)]
pub(super) struct MatchNetwork {
    network: Network,
}

impl MatchNetwork {
    /// The network of `role`.
    pub(super) fn load(manifest: &Manifest, role: Role) -> Result<Self, ModelError> {
        Ok(Self { network: Network::load(manifest, manifest.first(role)?)? })
    }

    /// Features of each image that it takes.
    pub(super) fn n_features(&self) -> usize {
        self.network.row().inputs[0].shape[1]
    }

    /// Adds the pairs that prefer one another.
    pub(super) fn match_features(
        &self,
        keyframe: &Features,
        current: &Features,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError> {
        let [n_keyframe, n_current] = [keyframe, current].map(|found| found.places.len().min(self.n_features()));
        if n_keyframe == 0 || n_current == 0 {
            return Ok(());
        }
        let [k, c] = [keyframe, current].map(|found| (self.places(found), self.descriptors(found)));
        let inputs = tvec![k.0, k.1, c.0, c.1].into_iter().enumerate();
        let inputs: Result<_, _> = inputs.map(|(idx, numbers)| self.network.input(idx, &numbers)).collect();
        let outputs = self.network.run(inputs?)?;
        let scores: &TValue = &outputs[0];
        let scores = self.network.numbers(scores)?;
        for (i, j, log_probability) in mutual_best(scores, self.n_features(), n_keyframe, n_current) {
            let confidence = log_probability.exp();
            if confidence > MIN_PROBABILITY {
                let (keyframe_px, current_px) = (keyframe.camera_px(i), current.camera_px(j));
                matches.push(PixelMatch { keyframe_px, current_px, confidence });
            }
        }
        Ok(())
    }

    /// Places relative to the image's centre, half the longer side is 1. Where there are fewer features than the network
    /// takes, they come again; the matches of those that come again are left out.
    fn places(&self, found: &Features) -> Vec<f32> {
        let (width, height) = (found.fit.content.0 as f32, found.fit.content.1 as f32);
        let half = 0.5 * width.max(height);
        let relative = |[x, y]: &[f32; 2]| [(x - 0.5 * width) / half, (y - 0.5 * height) / half];
        found.places.iter().cycle().take(self.n_features()).flat_map(relative).collect()
    }

    fn descriptors(&self, found: &Features) -> Vec<f32> {
        let n_numbers = self.network.row().inputs[1].shape.iter().product();
        found.descriptors.iter().copied().cycle().take(n_numbers).collect()
    }
}

/// Pairs (row, column, score) that are the best of their row and of their column, of the first `n_rows` and `n_columns`
/// of a matrix with `stride` columns. tract's LogSoftmax gives -inf for scores that are very small: these are no pairs.
fn mutual_best(scores: &[f32], stride: usize, n_rows: usize, n_columns: usize) -> Vec<(usize, usize, f32)> {
    let mut best_row = vec![(usize::MAX, f32::NEG_INFINITY); n_columns];
    let mut best_column = vec![(usize::MAX, f32::NEG_INFINITY); n_rows];
    for (i, of_row) in best_column.iter_mut().enumerate() {
        let row = &scores[i * stride..i * stride + n_columns];
        for (j, (&score, of_column)) in row.iter().zip(&mut best_row).enumerate() {
            if score > of_row.1 {
                *of_row = (j, score);
            }
            if score > of_column.1 {
                *of_column = (i, score);
            }
        }
    }
    let is_mutual =
        |(i, (j, score)): (usize, (usize, f32))| best_row.get(j).filter(|(row, _)| *row == i).map(|_| (i, j, score));
    best_column.into_iter().enumerate().filter_map(is_mutual).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pairs_that_prefer_one_another_are_pairs() {
        const NO: f32 = f32::NEG_INFINITY;
        let check = |rows: &[[f32; 4]], n_rows, n_columns, expected: &[(usize, usize)]| {
            let found = mutual_best(rows.as_flattened(), 4, n_rows, n_columns);
            let pairs: Vec<_> = found.iter().map(|&(i, j, _)| (i, j)).collect();
            assert_eq!(pairs, expected, "{rows:?}");
        };
        let rows = [[-1.0, -9.0, -9.0, -9.0], [-0.5, -2.0, -9.0, -9.0], [-9.0, -9.0, -9.0, -0.1]];
        check(&rows, 3, 4, &[(1, 0), (2, 3)]);
        check(&rows, 3, 3, &[(1, 0)]);
        check(&rows, 1, 4, &[(0, 0)]);
        check(&[[NO; 4], [NO; 4]], 2, 4, &[]);
        check(&[[f32::NAN; 4], [-1.0, NO, NO, NO]], 2, 4, &[(1, 0)]);
    }
}
