//! Shared helpers of the integration tests.

pub mod camera;
pub mod matchers;
pub mod program;
pub mod tracker;
pub mod truth;
