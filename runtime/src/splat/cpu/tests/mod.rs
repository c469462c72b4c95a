//! Tests of the whole chain.

mod compare;
mod golden;
