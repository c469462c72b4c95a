//! Splatting on the processor: explicit SIMD, a fixed memory, results that do not depend on the thread count.

mod simd;

pub mod decode;
pub mod lane;
pub mod project;

pub use simd::{Dispatch, SimdLevel};
