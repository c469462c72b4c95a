//! Pictures of a stored map: pages come from disk as the camera moves, within the backend's fixed capacity.
//!
//! [`MapViewer`] keeps the pages nearest to the camera in the backend. [`judge_map`] walks along the stored
//! keyframes and held-out views and compares, and so does [`measure_lpips`], by a network; [`command`] is `kilogs render`.

pub mod command;
mod judge;
mod lpips;
mod picture;
mod residency;
mod selection;
mod viewer;

pub use judge::{JudgedView, MapQuality, judge_map};
pub use lpips::measure_lpips;
pub use picture::Picture;
pub(crate) use residency::Residency;
pub(crate) use selection::{CountedPage, Room, Standpoint, Wanted, pick_pages};
pub(crate) use viewer::map_from_camera;
pub use viewer::{MapViewer, ViewerCounts};

#[cfg(test)]
mod stub;
#[cfg(test)]
mod tests;
