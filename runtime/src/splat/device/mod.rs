//! What the device backends share: everything but the driver's calls.

mod backend;
mod executor;
mod gradients;
mod slots;
mod view;

pub use backend::DeviceBackend;
pub use executor::{DeviceError, Executor};

#[cfg(test)]
mod tests;
