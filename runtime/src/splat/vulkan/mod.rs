//! The Vulkan device, through ash.
//!
//! All `unsafe` of the device backends is in this folder: calls of a C interface, and one mapping of memory that the
//! device sees too.

mod choice;
mod commands;
mod device;
mod executor;
mod import;
mod instance;
mod kernels;
mod listing;
mod memory;
mod sets;
mod spirv;

pub use choice::{DeviceInfo, DeviceKind, DeviceRequest, choose};
pub use device::VulkanDevice;
pub use executor::{LOSS_DRILL_VARIABLE, VulkanExecutor};
pub use import::{ImportedPages, PageSource};
pub use instance::{VALIDATION_VARIABLE, validation_messages};
pub use listing::list_devices;

/// The device backend on Vulkan.
pub type VulkanBackend = super::device::DeviceBackend<VulkanExecutor>;

#[cfg(test)]
pub(crate) mod testing;
#[cfg(test)]
mod tests;
