//! KiloGS: the parts that block, allocate or touch the world.
//!
//! Everything here allocates at start-up and then seals itself; `kilogs-core` does the calculating.

pub mod splat;
