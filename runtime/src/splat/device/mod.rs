//! What the device backends share: everything but the driver's calls.

mod executor;

pub use executor::{DeviceError, Executor};

#[cfg(test)]
mod tests;
