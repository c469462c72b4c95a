//! KiloGS: the parts that block, allocate or touch the world.
//!
//! Everything here allocates at start-up and then seals itself; `kilogs-core` does the calculating.

pub mod cli;
pub mod config;
pub mod settings;
pub mod doctor;
pub mod budget;
pub mod seal;
pub mod pool;
pub mod input;
pub mod output;
pub mod splat;
pub mod compute;
pub mod inference;
pub mod mapping;
pub mod map_store;
pub mod export;
pub mod render_views;
pub mod telemetry;
pub mod pipeline;
pub mod fit;
pub mod refine;

mod pose_file;
mod run_error;
pub use run_error::RunError;

#[cfg(test)]
#[global_allocator]
static ALLOCATOR: seal::CountingAllocator = seal::CountingAllocator;
