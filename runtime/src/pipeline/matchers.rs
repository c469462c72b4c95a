//! What the tracking thread asks when tracks break, on memory taken at the start.

use super::plan::RunPlan;
use crate::budget::{Row, Usage};
use crate::inference::{Counts, Domain, Wanted};
use crate::run_error::RunError;
use crate::settings::Matcher;
use kilogs_core::correspondence::{
    DenseMatcher, DenseNode, DenseSettings, DenseStorage, DepthPrior, DescriptorMatcher, DescriptorMatcherSettings,
    DescriptorStorage, ImagePair, PairMatcher, PixelMatch,
};
use kilogs_core::features::descriptors::{Feature, half_step_bytes};
use kilogs_core::features::hamming::{FeatureMatch, Nearest};
use kilogs_core::features::{Corner, SimdLevel};
use kilogs_core::scale::ScaleSource;
use kilogs_core::tracking::{Aids, Travelled};
use std::sync::Arc;
use std::sync::atomic::Ordering;

/// The matchers of a run; one that is switched off is not there.
pub struct Matchers {
    sparse: Sparse,
    dense: Option<Dense>,
    depth: Option<Box<dyn DepthPrior + Send>>,
    inference: Arc<Counts>,
}

enum Sparse {
    Descriptors(Box<DescriptorMatcher<'static>>),
    Learned(Box<dyn PairMatcher + Send>),
}

/// A dense matcher that knows whether it was asked.
struct Dense {
    matcher: Box<dyn PairMatcher + Send>,
    was_asked: bool,
}

impl Matchers {
    /// As the settings ask for; where a trained network is missing the classical matcher stands in.
    ///
    /// # Errors
    /// [`RunError::Run`] when the storage does not fit the camera, a defect of this function.
    pub fn open(plan: &RunPlan) -> Result<Self, RunError> {
        let Domain { sparse: learned, dense: learned_dense, depth, counts } = Domain::open(&wanted(plan));
        let sparse = match learned {
            Some(learned) => Sparse::Learned(learned),
            None => Sparse::Descriptors(Box::new(descriptors(plan)?)),
        };
        let matcher = match (plan.settings.tracking.dense_fallback, learned_dense) {
            (false, _) => None,
            (true, Some(learned)) => Some(learned),
            (true, None) => Some(dense(plan)?),
        };
        let dense = matcher.map(|matcher| Dense { matcher, was_asked: false });
        Ok(Self { sparse, dense, depth, inference: counts })
    }

    /// What a step may ask; `travelled` is what the wheels say about the way since the frame before.
    pub fn aids(&mut self, travelled: Option<Travelled>) -> Aids<'_> {
        let sparse: &mut dyn PairMatcher = match &mut self.sparse {
            Sparse::Descriptors(matcher) => &mut **matcher,
            Sparse::Learned(matcher) => &mut **matcher,
        };
        let dense = self.dense.as_mut().map(|dense| dense as &mut dyn PairMatcher);
        let depth = self.depth.as_mut().map(|depth| &mut **depth as &mut dyn DepthPrior);
        Aids { sparse: Some(sparse), dense, depth, travelled }
    }

    /// Notes how full the work spaces have been.
    pub fn observe(&self, usage: &Usage) {
        if let Sparse::Descriptors(matcher) = &self.sparse {
            usage.observe(Row::TrackingFeatures, matcher.keyframe_features().len());
        }
        usage.observe(Row::TrackingDenseMatchers, usize::from(self.dense.as_ref().is_some_and(|d| d.was_asked)));
        usage.observe(Row::InferenceArena, self.inference.peak_bytes.load(Ordering::Relaxed) as usize);
    }
}

impl PairMatcher for Dense {
    fn match_pair(&mut self, pair: &ImagePair<'_>, matches: &mut [PixelMatch]) -> usize {
        self.was_asked = true;
        self.matcher.match_pair(pair, matches)
    }
}

fn wanted(plan: &RunPlan) -> Wanted<'_> {
    let matcher = plan.settings.tracking.matcher;
    Wanted {
        matcher,
        dense: plan.settings.tracking.dense_fallback && matcher != Matcher::Classical,
        depth: plan.settings.tracking.tracker.scale_sources.contains(ScaleSource::DepthNetwork),
        settings: &plan.settings.inference,
        image: (plan.camera.width as usize, plan.camera.height as usize),
        focal_px: plan.camera.fx as f32,
        capacity: plan.budget.capacity(Row::TrackingTracks),
        cap_bytes: plan.budget.capacity(Row::InferenceArena) as u64,
        is_live: plan.is_live(),
    }
}

fn descriptors(plan: &RunPlan) -> Result<DescriptorMatcher<'static>, RunError> {
    let n = plan.budget.capacity(Row::TrackingFeatures);
    let (width, height) = (plan.camera.width as usize, plan.camera.height as usize);
    let storage = DescriptorStorage {
        half_step: kept(0, half_step_bytes(width, height)),
        corners: kept(Corner::NONE, n.div_ceil(2)),
        keyframe: kept(Feature::NONE, n),
        current: kept(Feature::NONE, n),
        nearest: kept(Nearest::NONE, 2 * n),
        matches: kept(FeatureMatch::default(), n),
    };
    let settings = DescriptorMatcherSettings::STANDARD;
    DescriptorMatcher::new(SimdLevel::new(), settings, [width, height], storage)
        .map_err(|e| RunError::Run(format!("setting up the descriptor matcher: {e}")))
}

fn dense(plan: &RunPlan) -> Result<Box<dyn PairMatcher + Send>, RunError> {
    let capacities = plan.budget.dense_capacities(&plan.memory_input);
    let storage = DenseStorage {
        volume: kept(0, capacities.volume_bytes()),
        pooled: kept(0, capacities.volume_bytes()),
        planes: kept(0.0, capacities.planes()),
        nodes: kept(DenseNode::NONE, capacities.nodes()),
        moved_nodes: kept(DenseNode::NONE, capacities.nodes()),
    };
    let matcher = DenseMatcher::new(SimdLevel::new(), DenseSettings::STANDARD, capacities, storage);
    Ok(Box::new(matcher.map_err(|e| RunError::Run(format!("setting up the dense matcher: {e}")))?))
}

/// Memory that lives as long as the process: taken once and never given back.
pub(super) fn kept<T: Clone>(empty: T, n: usize) -> &'static mut [T] {
    vec![empty; n].leak()
}
