//! Settings as meant: checked once at the start, read-only afterwards.
//!
//! There is no `Default`: the defaults are the built-in `config/default.toml`, read by [`config::load`](crate::config::load).

use crate::mapping::MapperSettings;
use kilogs_core::tracking::TrackingSettings as TrackerSettings;

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
    /// Looks for them and corrects the trajectory.
    pub enabled: bool,
}

/// Where correspondences come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Matcher {
    /// Optical flow.
    Classical,
}

impl Settings {
    /// What the stages were measured with; every value that is a setting is overwritten by the configuration.
    pub(crate) fn measured() -> Self {
        Self {
            tracking: TrackingSettings {
                tracker: TrackerSettings::STANDARD,
                dense_fallback: false,
                matcher: Matcher::Classical,
            },
            mapping: MappingSettings { enabled: true, mapper: MapperSettings::measured(0, 0.5) },
            loop_closure: LoopClosureSettings { enabled: false },
        }
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
