//! The shape of a configuration, before anything is made of it.

use crate::settings::{DynamicFilter, Matcher, PoseModels, Toggle};
use serde::Deserialize;

/// All sections; every key must be there, and no other.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawConfig {
    pub(crate) tracking: RawTracking,
    pub(crate) mapping: RawMapping,
    pub(crate) loop_closure: RawLoopClosure,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawTracking {
    pub(crate) pose_models: PoseModels,
    pub(crate) dynamic_filter: DynamicFilter,
    pub(crate) dense_fallback: Toggle,
    pub(crate) bundle_adjustment: Toggle,
    pub(crate) matcher: Matcher,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawMapping {
    pub(crate) enabled: bool,
    pub(crate) resolution: f64,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RawLoopClosure {
    pub(crate) enabled: bool,
}
