//! LPIPS: how different two pictures look to a network that was fitted to what people say of pairs of pictures.

use super::ModelError;
use super::manifest::{Manifest, Role};
use super::network::Network;
use std::panic::{AssertUnwindSafe, catch_unwind};
use tract_onnx::prelude::{TValue, tvec};

/// A network that compares pictures of one size.
#[derive(Debug)]
pub(super) struct LpipsNetwork {
    network: Network,
    planes: Vec<f32>,
}

impl LpipsNetwork {
    /// The manifest's network for pictures of a width and a height, px. They are never resized, for that changes the
    /// distance.
    pub(super) fn load(manifest: &Manifest, size: (usize, usize)) -> Result<Self, ModelError> {
        let row = manifest.first(Role::Lpips)?;
        let Some(row) = manifest.of_role(Role::Lpips).find(|row| row.image_size() == size) else {
            return Err(ModelError::OtherSize { name: row.name.clone(), takes: row.image_size(), pictures: size });
        };
        let load = || Network::load(manifest, row);
        // What the library does with a strange file is not ours to foresee.
        let loaded = catch_unwind(AssertUnwindSafe(load)).unwrap_or(Err(ModelError::Panicked { what: "LPIPS" }));
        Ok(Self { network: loaded?, planes: Vec::with_capacity(3 * size.0 * size.1) })
    }

    /// The distance between two pictures, RGB row by row with white at 1: 0 where they look the same.
    ///
    /// # Source
    /// Zhang et al., The Unreasonable Effectiveness of Deep Features as a Perceptual Metric, CVPR 2018, eq. 1.
    pub(super) fn between(&mut self, first: &[[f32; 3]], second: &[[f32; 3]]) -> Result<f32, ModelError> {
        let (first, second) = (self.input(0, first)?, self.input(1, second)?);
        let outputs = self.network.run(tvec![first, second])?;
        let distance = self.network.numbers(&outputs[0])?.first().copied();
        Ok(distance.unwrap_or(f32::NAN))
    }

    fn input(&mut self, idx: usize, picture: &[[f32; 3]]) -> Result<TValue, ModelError> {
        self.planes.clear();
        self.planes.extend((0..3).flat_map(|channel| picture.iter().map(move |rgb| rgb[channel])));
        self.network.input(idx, &self.planes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::Path;

    fn open(size: (usize, usize)) -> Result<LpipsNetwork, ModelError> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/models");
        LpipsNetwork::load(&Manifest::find(&folder).expect("part of the source tree"), size)
    }

    #[test]
    fn pictures_arrive_channel_by_channel() {
        let mut network = open((32, 16)).expect("loaded");
        let black = vec![[0.0; 3]; 32 * 16];
        // Red counts three times, blue not at all.
        for (channel, expected) in [(0, 3.0), (1, 1.0), (2, 0.0)] {
            let mut picture = black.clone();
            picture[40][channel] = 0.5;
            let distance = network.between(&picture, &black).expect("compared");
            assert!((distance - expected * 0.25 / (3.0 * 512.0)).abs() < 1e-7, "channel {channel}: {distance}");
        }
        assert_eq!(network.between(&black, &black).expect("compared"), 0.0);
    }

    #[test]
    fn pictures_are_never_resized() {
        let problem = open((1241, 376)).expect_err("no network for that size").to_string();
        assert!(problem.contains("takes 32 x 16 px, they have 1241 x 376 px"), "{problem}");
    }
}
