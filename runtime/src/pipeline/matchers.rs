//! What the tracking thread asks when tracks break, on memory taken at the start.

use super::plan::RunPlan;
use crate::budget::{Row, Usage};
use crate::run_error::RunError;
use kilogs_core::correspondence::{
    DenseMatcher, DenseNode, DenseSettings, DenseStorage, ImagePair, PairMatcher, PixelMatch,
};
use kilogs_core::features::SimdLevel;
use kilogs_core::tracking::Aids;

/// The matchers of a run; one that is switched off is not there.
pub struct Matchers {
    dense: Option<Asked>,
}

impl Matchers {
    /// As the settings ask for.
    ///
    /// # Errors
    /// [`RunError::Run`] when the storage does not fit the camera, a defect of this function.
    pub fn open(plan: &RunPlan) -> Result<Self, RunError> {
        let dense = plan.settings.tracking.dense_fallback.then(|| dense(plan)).transpose()?;
        Ok(Self { dense: dense.map(|matcher| Asked { matcher, n_times: 0 }) })
    }

    /// What a step may ask.
    pub fn aids(&mut self) -> Aids<'_> {
        Aids { dense: self.dense.as_mut().map(|asked| asked as &mut dyn PairMatcher), ..Aids::default() }
    }

    /// Notes which work spaces have been used.
    pub fn observe(&self, usage: &Usage) {
        usage.observe(Row::TrackingDenseMatchers, usize::from(self.dense.as_ref().is_some_and(|d| d.n_times > 0)));
    }
}

/// A matcher that knows how often it was asked.
struct Asked {
    matcher: Box<dyn PairMatcher + Send>,
    n_times: u64,
}

impl PairMatcher for Asked {
    fn match_pair(&mut self, pair: &ImagePair<'_>, matches: &mut [PixelMatch]) -> usize {
        self.n_times += 1;
        self.matcher.match_pair(pair, matches)
    }
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
