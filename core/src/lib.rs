//! Everything of KiloGS that can be computed without the outside world.
//!
//! The folders follow the data: an image comes in at the top, a verified pose and a map entry come out
//! at the bottom. Nothing here allocates, blocks, reads a clock or fails because of the outside world;
//! memory is handed in by the caller and every bound is stated where the memory is taken.
#![no_std]
#![forbid(unsafe_code)]

#[cfg(test)]
extern crate std;

pub mod conventions;

pub mod frame;

pub mod features;

pub mod correspondence;

pub mod gate;

pub mod pose;

pub mod scale;

pub mod verify;

pub mod keyframe;

pub mod bundle;

pub mod pose_graph;

pub mod tracking;

pub mod places;

pub mod loop_closure;

pub mod map;

pub mod store;

pub mod camera;
pub mod math;
