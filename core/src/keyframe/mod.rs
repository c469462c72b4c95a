//! The last keyframes and the landmarks that they share.

mod landmark;
mod window;

pub use landmark::{Column, Landmark, WINDOW};
pub use window::{Keyframe, KeyframeWindow, LandmarkView, SHORTEST_BASELINE_M};
