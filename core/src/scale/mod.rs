//! Metres without a network: the road under the camera is at a known distance.

pub mod ground_plane;
mod scale_filter;
mod strip;
mod tiles;

pub use ground_plane::{RoadAlignment, RoadPair, RoadProblem, RoadSettings, align_road};
pub use scale_filter::{ScaleFilter, ScaleFilterSettings, ScaleUpdate};

#[cfg(test)]
mod tests;
