//! Small mathematics shared by the stages.

pub mod rng;
pub mod se3;
pub mod sim3;

pub use rng::Rng;
