//! What the run reports about itself while it goes on.

mod memory;
mod slope;

pub use memory::{MemoryWatch, ProcessMemory, process_memory};
pub use slope::RssSlope;
