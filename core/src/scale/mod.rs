//! Metres without a network: the road under the camera is at a known distance.

pub mod ground_plane;
mod scale_filter;
mod sources;
mod strip;
mod tiles;

pub use ground_plane::{RoadAlignment, RoadPair, RoadProblem, RoadSettings, align_road};
pub use scale_filter::{ScaleFilter, ScaleFilterSettings, ScaleUpdate};
pub use sources::{MAX_DEPTHS, ScaleMeasurement, ScaleSource, depth_ratio, wheel_ratio};

#[cfg(test)]
mod tests;
