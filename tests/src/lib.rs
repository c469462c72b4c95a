//! Shared helpers of the integration tests.

pub mod camera;
pub mod program;
pub mod tracker;
