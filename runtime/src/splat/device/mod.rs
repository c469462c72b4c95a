//! What the device backends share: everything but the driver's calls.

mod arena;
mod backend;
mod error;
mod executor;
mod fallback;
mod gradients;
mod host_copy;
mod runs;
mod score;
mod slots;
mod training;
mod view;

pub use arena::{Arena, ArenaFull, ArenaRange, EXCHANGE_BYTES, arena_bytes};
pub use backend::DeviceBackend;
pub use error::DeviceError;
pub use executor::Executor;
pub use fallback::{CanFail, FallbackBackend, MakeSubstitute};
pub use host_copy::HostCopy;

#[cfg(test)]
mod tests;
