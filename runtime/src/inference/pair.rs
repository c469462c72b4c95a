//! A network that looks at both images at once and describes every pixel of both: MASt3R and its kind.
//!
//! Pixels of the keyframe, the most certain of each square of a grid, look for their best likeness among all pixels of the
//! current image, and from there back; those that come back to where they started are matches.
//!
//! # Source
//! Leroy et al., ECCV 2024, sec. 3.3 (reciprocal neighbours from a grid), with one turn in place of a few.

use super::ModelError;
use super::manifest::{Manifest, Role};
use super::nearest;
use super::network::Network;
use super::picture::{Fit, Picture};
use kilogs_core::correspondence::PixelMatch;
use tract_onnx::prelude::tvec;

/// Squares of the keyframe at most. The authors look from every eighth pixel, which are fewer.
const N_SQUARES: usize = 4096;
/// A match comes back to within this many pixels of where it started. Ours: neighbours are hardly told apart.
const RETURNS_WITHIN_PX: usize = 2;

/// The network.
#[derive(Debug)]
pub(super) struct PairNetwork {
    network: Network,
}

/// What it says of the pixels of one image.
struct Described {
    /// Width and height of the map that show the image.
    content: (usize, usize),
    /// A unit vector for each of its pixels, row by row.
    descriptors: Vec<f32>,
    /// How certain each is.
    confidences: Vec<f32>,
    n_channels: usize,
}

impl PairNetwork {
    /// The network of the manifest, if there is a row for one.
    pub(super) fn load(manifest: &Manifest) -> Result<Option<Self>, ModelError> {
        let row = manifest.of_role(Role::DensePair).next();
        row.map(|row| Network::load(manifest, row).map(|network| Self { network })).transpose()
    }

    /// Replaces `matches` by those of the two images, which have the same size.
    pub(super) fn match_pair(
        &self,
        keyframe: &Picture,
        current: &Picture,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError> {
        matches.clear();
        let row = self.network.row();
        let fit = Fit::new((keyframe.width, keyframe.height), row.image_size());
        let channels = vec![(0.0, 1.0); row.inputs[0].shape[1]];
        let input = |idx: usize, picture: &Picture| self.network.input(idx, &fit.planes(picture, &channels));
        let outputs = self.network.run(tvec![input(0, keyframe)?, input(1, current)?])?;
        let numbers = |idx: usize| self.network.numbers(&outputs[idx]);
        let described = |first: usize| {
            let shape = &row.outputs[first].shape;
            Ok(Described::of_content(fit, [shape[1], shape[2], shape[3]], numbers(first)?, numbers(first + 1)?))
        };
        let (of_keyframe, of_current) = (described(0)?, described(2)?);
        let map_width = row.outputs[0].shape[3];
        let network_px_per_map_px = fit.input.0 as f32 / map_width as f32;
        let to_px = |width: usize, pixel: usize| {
            let at = [pixel % width, pixel / width].map(|c| (c as f32 + 0.5) * network_px_per_map_px);
            fit.camera_px(at)
        };
        for (from, to, confidence) in of_keyframe.matches(&of_current) {
            let keyframe_px = to_px(of_keyframe.content.0, from);
            matches.push(PixelMatch { keyframe_px, current_px: to_px(of_current.content.0, to), confidence });
        }
        Ok(())
    }
}

impl Described {
    /// What of the maps, channel by channel, shows the image and not the border beyond it.
    fn of_content(fit: Fit, [n_channels, height, width]: [usize; 3], maps: &[f32], confidences: &[f32]) -> Self {
        let along = |content: usize, input: usize, map: usize| (content * map / input.max(1)).clamp(1, map);
        let content = (along(fit.content.0, fit.input.0, width), along(fit.content.1, fit.input.1, height));
        let pixels = || (0..content.1).flat_map(move |y| (0..content.0).map(move |x| y * width + x));
        let channels = |pixel: usize| (0..n_channels).map(move |channel| maps[channel * width * height + pixel]);
        Self {
            content,
            descriptors: pixels().flat_map(channels).collect(),
            confidences: pixels().map(|pixel| confidences[pixel]).collect(),
            n_channels,
        }
    }

    /// Pixels of this image and of the other that find each other, and how alike they are.
    fn matches(&self, other: &Self) -> Vec<(usize, usize, f32)> {
        let starts = self.most_certain();
        let there = nearest::best(&self.of(&starts), &other.descriptors, self.n_channels);
        type Found = (usize, usize, f32);
        let found: Vec<Found> = starts
            .into_iter()
            .zip(there)
            .filter(|(_, (_, likeness))| *likeness > 0.0)
            .map(|(start, (end, likeness))| (start, end, likeness.min(1.0)))
            .collect();
        let ends: Vec<_> = found.iter().map(|(_, end, _)| *end).collect();
        let back = nearest::best(&other.of(&ends), &self.descriptors, self.n_channels);
        let apart = |a: usize, b: usize| {
            let [ax, ay, bx, by] = [a % self.content.0, a / self.content.0, b % self.content.0, b / self.content.0];
            ax.abs_diff(bx).max(ay.abs_diff(by))
        };
        let returns =
            |&((start, _, _), (returned, _)): &(Found, (usize, f32))| apart(start, returned) <= RETURNS_WITHIN_PX;
        found.into_iter().zip(back).filter(returns).map(|(found, _)| found).collect()
    }

    /// The most certain pixel of each square of a grid.
    fn most_certain(&self) -> Vec<usize> {
        let (width, height) = self.content;
        let side = ((width * height).div_ceil(N_SQUARES) as f64).sqrt().ceil() as usize;
        let columns = width.div_ceil(side);
        let mut best = vec![(usize::MAX, 0.0_f32); columns * height.div_ceil(side)];
        for (pixel, &confidence) in self.confidences.iter().enumerate() {
            let square = &mut best[pixel / width / side * columns + pixel % width / side];
            if confidence > square.1 {
                *square = (pixel, confidence);
            }
        }
        best.into_iter().map(|(pixel, _)| pixel).filter(|&pixel| pixel != usize::MAX).collect()
    }

    fn of(&self, pixels: &[usize]) -> Vec<f32> {
        let row = |&pixel: &usize| &self.descriptors[pixel * self.n_channels..(pixel + 1) * self.n_channels];
        pixels.iter().flat_map(row).copied().collect()
    }
}
