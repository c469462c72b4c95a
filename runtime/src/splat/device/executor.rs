//! The seam between a program and a driver.

use crate::splat::program::{Buffer, Part, WorkSize};

/// Why a device could not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// No device, or none that can run the kernels.
    #[error("opening a {api} device: {reason}: use --backend cpu, or install a Vulkan driver (mesa-vulkan-drivers)")]
    NoDevice {
        /// `Vulkan` or `wgpu`.
        api: &'static str,
        /// What is missing.
        reason: String,
    },
    /// A buffer is larger than the device allows.
    #[error("device buffer {name} needs {bytes} bytes, the device allows {limit}: lower the row in memory_budget.toml")]
    BufferTooLarge {
        /// Name of the buffer.
        name: &'static str,
        /// What it needs.
        bytes: usize,
        /// What the device allows.
        limit: usize,
    },
    /// The buffers together are larger than the cap.
    #[error("device buffers need {bytes} bytes, device_bytes allows {cap}: lower capacities in memory_budget.toml")]
    ArenaTooLarge {
        /// What all buffers need.
        bytes: usize,
        /// What is allowed.
        cap: usize,
    },
    /// A kernel did not compile.
    #[error("compiling kernel {kernel}: {reason}")]
    Kernel {
        /// Name of the kernel.
        kernel: &'static str,
        /// What the compiler or driver said.
        reason: String,
    },
    /// The device is gone: its buffers with it. The caller falls back to the CPU backend.
    #[error("the device was lost while {doing}: {reason}")]
    Lost {
        /// What was being done.
        doing: &'static str,
        /// What the driver said.
        reason: String,
    },
}

/// Runs programs on one device; owns one buffer per row of [`buffer_plan`](crate::splat::program::buffer_plan), all zero
/// at first, and one pipeline per row of [`KERNELS`](crate::splat::kernels::KERNELS).
///
/// Calls take effect in the order in which they are made. Offsets and lengths are multiples of 4 bytes and within the
/// buffer. After an error of kind [`DeviceError::Lost`] every further call may fail.
pub trait Executor: Send {
    /// Copies bytes into a buffer. The bytes may be reused on return; nothing is waited for.
    fn upload(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &[u8]) -> Result<(), DeviceError>;

    /// Sets bytes of a buffer to zero.
    fn clear(&mut self, buffer: Buffer, offset_bytes: usize, len_bytes: usize) -> Result<(), DeviceError>;

    /// Submits the stages of the parts one after the other; every stage sees what the stages before it wrote. Need
    /// not wait for them.
    fn run(&mut self, parts: &[Part], work: &WorkSize) -> Result<(), DeviceError>;

    /// Waits for everything so far and copies bytes of a buffer back.
    fn download(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &mut [u8]) -> Result<(), DeviceError>;

    /// Name of the device for reports.
    fn device_name(&self) -> &str;

    /// Bytes of device memory that the buffers take.
    fn device_bytes(&self) -> usize;
}
