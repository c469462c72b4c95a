//! Verification with memory of its own.

use crate::drive::Keyframe;
use kilogs_core::camera::Pinhole;
use kilogs_core::features::{FeatureMatch, Nearest, SimdLevel};
use kilogs_core::math::Rng;
use kilogs_core::places::{LoopEvidence, LoopScratch, PlaceView, VerificationSettings, verify_loop};
use kilogs_core::pose::{Match, PointMatch};

/// Verifies one pair of keyframes after the other.
pub(crate) struct Verifier {
    camera: Pinhole,
    nearest: Vec<Nearest>,
    pairs: Vec<FeatureMatch>,
    matches: Vec<Match>,
    point_matches: Vec<PointMatch>,
    is_inlier: Vec<bool>,
}

impl Verifier {
    /// For keyframes of so many points.
    pub(crate) fn new(camera: Pinhole, n: usize) -> Self {
        Self {
            camera,
            nearest: vec![Nearest::NONE; 2 * n],
            pairs: vec![FeatureMatch::default(); n],
            matches: vec![Match::default(); n],
            point_matches: vec![PointMatch::default(); n],
            is_inlier: vec![false; n],
        }
    }

    /// What decides about this pair.
    pub(crate) fn verify(&mut self, view: &Keyframe, earlier: &Keyframe) -> LoopEvidence {
        let [seen, stored] = [view, earlier].map(|k| PlaceView { features: &k.points, depths: &k.depths });
        let mut scratch = LoopScratch {
            nearest: &mut self.nearest,
            pairs: &mut self.pairs,
            matches: &mut self.matches,
            point_matches: &mut self.point_matches,
            is_inlier: &mut self.is_inlier,
        };
        let mut rng = Rng::new(0, view.frame, earlier.frame);
        let settings = VerificationSettings::STANDARD;
        verify_loop(SimdLevel::new(), &self.camera, &seen, &stored, &settings, &mut rng, &mut scratch).1
    }
}
