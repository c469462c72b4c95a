//! Settings as meant: checked once at the start, read-only afterwards.
//!
//! There is no `Default`: the defaults are the built-in `config/default.toml`, read by [`config::load`](crate::config::load).

use crate::inference::Role;
use crate::mapping::MapperSettings;
use crate::refine::LifecycleSettings;
use kilogs_core::loop_closure::{AlignmentLimits, LoopSettings, OdometryNoise};
use kilogs_core::scale::ScaleSource;
use kilogs_core::tracking::TrackingSettings as TrackerSettings;
use std::path::PathBuf;
use std::time::Duration;

/// Everything that changes results and is not a capacity.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Settings {
    /// From images to poses.
    pub tracking: TrackingSettings,
    /// From poses and images to the map.
    pub mapping: MappingSettings,
    /// How Gaussians come and go while a map is refined.
    pub lifecycle: LifecycleSettings,
    /// Places seen before.
    pub loop_closure: LoopClosureSettings,
    /// Trained networks.
    pub inference: InferenceSettings,
}

/// From images to poses.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct TrackingSettings {
    /// Constants of the tracker itself.
    pub tracker: TrackerSettings,
    /// Dense matching after an anomaly.
    pub dense_fallback: bool,
    /// Where correspondences come from.
    pub matcher: Matcher,
}

/// From poses and images to the map.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct MappingSettings {
    /// Builds a map at all.
    pub enabled: bool,
    /// Constants of the mapper itself.
    pub mapper: MapperSettings,
}

/// Places seen before.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct LoopClosureSettings {
    /// Looks for them and corrects the map and the trajectory.
    pub enabled: bool,
    /// Vocabulary file; where it is empty, the usual places are searched.
    pub vocabulary: PathBuf,
    /// What is believed.
    pub closer: LoopSettings,
    /// What odometry loses on its way.
    pub noise: OdometryNoise,
    /// How fast the published `map_from_odometry` follows the map.
    pub alignment: AlignmentLimits,
}

/// Trained networks.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct InferenceSettings {
    /// Folder with a `manifest.toml`; where it is empty, the usual places are searched.
    pub models: PathBuf,
    /// Networks with wider images are not used, px.
    pub max_width_px: usize,
    /// How long an answer may take when the camera sets the pace.
    pub deadline: Duration,
}

/// Where correspondences come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Matcher {
    /// Optical flow.
    Classical,
    /// XFeat keypoints, matched by LighterGlue.
    XFeat,
    /// DISK keypoints, matched by LightGlue.
    Disk,
}

impl Matcher {
    /// The networks that it needs: one that finds features and one that matches them; none for the classical one.
    pub fn roles(self) -> &'static [Role] {
        match self {
            Self::Classical => &[],
            Self::XFeat => &[Role::XfeatFeatures, Role::XfeatMatcher],
            Self::Disk => &[Role::DiskFeatures, Role::DiskMatcher],
        }
    }
}

impl Settings {
    /// What the stages were measured with; every value that is a setting is overwritten by the configuration.
    pub(crate) fn measured() -> Self {
        Self {
            tracking: TrackingSettings {
                tracker: TrackerSettings::STANDARD,
                dense_fallback: true,
                matcher: Matcher::Classical,
            },
            mapping: MappingSettings { enabled: true, mapper: MapperSettings::measured(0, 0.5) },
            lifecycle: LifecycleSettings::MEASURED,
            loop_closure: LoopClosureSettings {
                enabled: true,
                vocabulary: PathBuf::new(),
                closer: LoopSettings::STANDARD,
                noise: OdometryNoise::STANDARD,
                alignment: AlignmentLimits::STANDARD,
            },
            inference: InferenceSettings {
                models: PathBuf::new(),
                max_width_px: 1248,
                deadline: Duration::from_millis(1000),
            },
        }
    }

    /// Trained networks run beside the tracker.
    pub fn has_networks(&self) -> bool {
        self.tracking.matcher != Matcher::Classical
            || self.tracking.tracker.scale_sources.contains(ScaleSource::DepthNetwork)
    }

    /// Two settings that contradict each other: the key to change, and what is wrong.
    pub(crate) fn contradiction(&self) -> Option<(&'static str, String)> {
        let [nearest_m, farthest_m] = self.tracking.tracker.road.distance_m;
        if nearest_m >= farthest_m {
            return Some(("tracking.road_farthest_m", format!("not above tracking.road_nearest_m = {nearest_m}")));
        }
        let mapper = &self.mapping.mapper;
        let stereo = &mapper.stereo;
        if stereo.nearest_m >= stereo.farthest_m {
            let problem = format!("not above mapping.stereo_nearest_m = {}", stereo.nearest_m);
            return Some(("mapping.stereo_farthest_m", problem));
        }
        if mapper.newest_share + mapper.older_share > 1.0 {
            let problem = format!("together with mapping.newest_share = {} above 1", mapper.newest_share);
            return Some(("mapping.older_share", problem));
        }
        None
    }
}
