//! The seam between a program and a driver.

use super::error::DeviceError;
use crate::splat::program::{Buffer, Part, WorkSize};

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

    /// Submits one stage of a part alone, to be timed; the stages of a part one by one do what [`run`](Self::run) does.
    fn run_stage(&mut self, part: Part, stage: usize, work: &WorkSize) -> Result<(), DeviceError>;

    /// Waits for everything so far and copies bytes of a buffer back.
    fn download(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &mut [u8]) -> Result<(), DeviceError>;

    /// Name of the device for reports.
    fn device_name(&self) -> &str;

    /// Bytes of device memory that the buffers take.
    fn device_bytes(&self) -> usize;
}
