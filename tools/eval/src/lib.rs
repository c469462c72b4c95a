//! Figures that say how good a run was: of the trajectory against ground truth, and of rendered images.
//!
//! Everything is a plain function of trajectories or images in memory; `command` is what `kilogs eval` runs.
//! The trajectory figures equal those of the public package `evo`, the image figures those of scikit-image
//! (`tests/` holds both to stored numbers).

pub mod trajectory;

pub mod associate;

pub mod align;

pub mod ate;
pub mod rpe;
pub mod segments;

pub mod image_quality;

pub mod command;
pub mod stdout;

mod json_file;

pub use command::{EvalArgs, EvalError, LpipsFigures, run};
pub use image_quality::{ImageQuality, ImageQualityMeter};
pub use json_file::replace_json;
