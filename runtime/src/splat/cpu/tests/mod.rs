//! Tests of the whole chain.

mod behavior;
pub mod compare;
mod decoder;
mod differences;
mod fitting;
pub mod golden;
mod lanes;
mod loss;
mod reference;
pub mod scenes;
