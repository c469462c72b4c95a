//! Matching two images by what is found in each; what is found in a keyframe is kept until another one comes.

use super::ModelError;
use super::picture::Picture;
use kilogs_core::correspondence::PixelMatch;

/// Networks that find something in an image, and the same things in two images.
pub(super) trait FindAndMatch {
    /// What is found in an image.
    type Found;

    /// Looks at one image.
    fn find(&self, picture: &Picture) -> Result<Self::Found, ModelError>;

    /// Adds the matches of what was found in two images.
    fn match_found(
        &self,
        keyframe: &Self::Found,
        current: &Self::Found,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError>;
}

/// Networks, and what they found in the last keyframe.
#[derive(Debug)]
pub(super) struct TwoViews<N: FindAndMatch> {
    networks: N,
    keyframe: Option<(u32, N::Found)>,
}

impl<N: FindAndMatch> TwoViews<N> {
    /// Networks that were run once, on this picture and itself.
    pub(super) fn tried(networks: N, picture: &Picture) -> Result<Self, ModelError> {
        let found = networks.find(picture)?;
        networks.match_found(&found, &networks.find(picture)?, &mut Vec::new())?;
        Ok(Self { networks, keyframe: None })
    }

    /// Replaces `matches` by those of the two images.
    pub(super) fn match_pair(
        &mut self,
        (ordinal, keyframe): (u32, &Picture),
        current: &Picture,
        matches: &mut Vec<PixelMatch>,
    ) -> Result<(), ModelError> {
        matches.clear();
        let known = self.keyframe.take().filter(|(known, _)| *known == ordinal);
        let (_, of_keyframe) = match known {
            Some(known) => known,
            None => (ordinal, self.networks.find(keyframe)?),
        };
        let of_current = self.networks.find(current)?;
        let matched = self.networks.match_found(&of_keyframe, &of_current, matches);
        self.keyframe = Some((ordinal, of_keyframe));
        matched
    }
}
