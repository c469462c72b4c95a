//! Tests of the whole chain.

mod behavior;
pub mod compare;
pub mod decoder;
mod differences;
mod fitting;
pub mod golden;
mod lanes;
mod loss;
pub mod pose;
mod reference;
pub mod scenes;
pub mod scores;
pub mod views;
