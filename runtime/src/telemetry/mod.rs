//! What the run reports about itself while it goes on.

mod memory;
mod processor;
mod slope;

pub use memory::{MemoryWatch, ProcessMemory, process_memory};
pub use processor::processor_name;
pub use slope::{Growth, RssSlope};
