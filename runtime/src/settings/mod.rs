//! Settings as meant: checked once at the start, read-only afterwards.
//!
//! There is no `Default`: the defaults are the built-in `config/default.toml`, read by [`config::load`](crate::config::load).

use crate::config::RawConfig;
use serde::Deserialize;

/// Everything that changes results and is not a capacity.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Settings {
    /// From images to poses.
    pub tracking: TrackingSettings,
    /// From poses and images to the map.
    pub mapping: MappingSettings,
    /// Places seen before.
    pub loop_closure: LoopClosureSettings,
}

/// From images to poses.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct TrackingSettings {
    /// How the pose of a frame is found.
    pub pose_models: PoseModels,
    /// What removes matches on moving objects.
    pub dynamic_filter: DynamicFilter,
    /// Dense matching after an anomaly.
    pub dense_fallback: bool,
    /// Windowed bundle adjustment over the keyframe ring.
    pub bundle_adjustment: bool,
    /// Where correspondences come from.
    pub matcher: Matcher,
}

/// From poses and images to the map.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct MappingSettings {
    /// Builds a map at all.
    pub enabled: bool,
    /// Size of the training images relative to the camera's.
    pub resolution: f64,
}

/// Places seen before.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct LoopClosureSettings {
    /// Looks for them and corrects the trajectory.
    pub enabled: bool,
}

/// How the pose of a frame is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseModels {
    /// Essential matrix where the motion allows, perspective-n-point where it does not.
    Both,
    /// Essential matrix only.
    Essential,
    /// Perspective-n-point only.
    Pnp,
}

/// What removes matches on moving objects.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DynamicFilter {
    /// Nothing before the robust solver.
    Off,
    /// The paper's rule: flow above median + 3 MAD over the whole image.
    Paper,
    /// The same rule per image region.
    Region,
}

/// Where correspondences come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Matcher {
    /// Optical flow and binary descriptors.
    Classical,
    /// A network of the XFeat family.
    Xfeat,
    /// A network of the DISK family.
    Disk,
}

/// `on` or `off`, as typed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Toggle {
    On,
    Off,
}

impl Settings {
    /// Makes settings of a configuration whose values are within their ranges.
    pub(crate) fn from_raw(raw: RawConfig) -> Self {
        let RawConfig { tracking, mapping, loop_closure } = raw;
        Self {
            tracking: TrackingSettings {
                pose_models: tracking.pose_models,
                dynamic_filter: tracking.dynamic_filter,
                dense_fallback: tracking.dense_fallback == Toggle::On,
                bundle_adjustment: tracking.bundle_adjustment == Toggle::On,
                matcher: tracking.matcher,
            },
            mapping: MappingSettings { enabled: mapping.enabled, resolution: mapping.resolution },
            loop_closure: LoopClosureSettings { enabled: loop_closure.enabled },
        }
    }
}
