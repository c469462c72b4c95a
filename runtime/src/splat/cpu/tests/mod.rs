//! Tests of the whole chain.

mod behavior;
mod compare;
mod differences;
mod fitting;
mod golden;
mod lanes;
mod loss;
mod reference;
mod scenes;
