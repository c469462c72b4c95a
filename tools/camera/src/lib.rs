//! The capture process as a library: where frames come from, and how they are published.

pub mod sim;
pub mod source;
