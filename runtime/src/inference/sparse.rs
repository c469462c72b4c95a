//! Keypoints of both images, matched: XFeat + LighterGlue, or DISK + LightGlue.

use super::ModelError;
use super::features::{FeatureNetwork, Features};
use super::glue::MatchNetwork;
use super::manifest::{Manifest, Role};
use super::picture::Picture;
use super::two_views::FindAndMatch;
use kilogs_core::correspondence::PixelMatch;

/// A network that finds keypoints and one that matches them.
#[derive(Debug)]
pub(super) struct Keypoints {
    features: FeatureNetwork,
    glue: MatchNetwork,
}

impl Keypoints {
    /// The networks for images of this size.
    pub(super) fn load(
        manifest: &Manifest,
        (features, glue): (Role, Role),
        image: ((usize, usize), usize),
    ) -> Result<Self, ModelError> {
        let glue = MatchNetwork::load(manifest, glue)?;
        let features = FeatureNetwork::load(manifest, features, image, glue.n_features())?;
        Ok(Self { features, glue })
    }
}

impl FindAndMatch for Keypoints {
    type Found = Features;

    fn find(&self, picture: &Picture) -> Result<Features, ModelError> {
        self.features.find(picture)
    }

    fn match_found(
        &self,
        keyframe: &Features,
        current: &Features,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError> {
        self.glue.match_features(keyframe, current, matches)
    }
}
