//! The capture process as a library: where frames come from, and how they are published.

pub mod camera_file;
mod noise;
pub mod sim;
pub mod source;

pub mod ipc;
pub mod publish;

pub mod cli;
