//! Metres: the road under the camera is at a known distance, a network knows depths, wheels roll; one filter merges them.

mod equations;
pub mod ground_plane;
mod scale_filter;
mod sources;
mod strip;
mod tiles;

pub use ground_plane::{RoadAlignment, RoadPair, RoadProblem, RoadSettings, align_road};
pub use scale_filter::{ScaleFilter, ScaleFilterSettings, ScaleUpdate};
pub use sources::{MAX_DEPTHS, ScaleMeasurement, ScaleSource, ScaleSources, depth_ratio, wheel_ratio};

#[cfg(test)]
mod tests;
