//! What can go wrong with a compute device.

use super::arena::ArenaFull;

/// Why a compute device cannot be used, or can no longer be.
///
/// Every text says what was being done, to which object, why, and what to try. Nothing of it stops tracking: the mapper
/// goes on with the CPU backend (`ARCHITECTURE.md`, "When the device is gone").
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum DeviceError {
    /// No device, or none that can run the kernels. Use the CPU backend, or name another device.
    #[error("opening a {api} device: {reason}; `kilogs doctor` lists the devices, --backend cpu needs none")]
    NoDevice {
        /// `Vulkan` or `wgpu`.
        api: &'static str,
        /// What is missing.
        reason: String,
    },
    /// A buffer is larger than the device allows. Lower the row.
    #[error(
        "planning the device memory: [{name}] needs {bytes} B in one buffer, the device allows {limit} B; lower the \
         capacity behind it in memory_budget.toml, or use --backend cpu"
    )]
    BufferTooLarge {
        /// Name of the buffer.
        name: &'static str,
        /// What it needs.
        bytes: usize,
        /// What the device allows.
        limit: usize,
    },
    /// A buffer has more elements than one dispatch of the device can walk. Lower the row.
    #[error(
        "planning the kernels: [{name}] needs {groups} workgroups at once, the device takes {limit}; lower the capacity \
         behind it in memory_budget.toml, or use --backend cpu"
    )]
    TooManyGroups {
        /// Name of the buffer.
        name: &'static str,
        /// Workgroups that it needs.
        groups: u32,
        /// Workgroups that the device takes.
        limit: u32,
    },
    /// A row does not fit into the arena that the budget grants. Lower the row.
    #[error(transparent)]
    ArenaFull(#[from] ArenaFull),
    /// The device does not have, or does not give, the memory of the plan. Lower the budget.
    #[error(
        "taking {needed} B of memory on {device}: it gives {available} B at most; lower the largest row of `kilogs \
         budget`, or use --backend cpu"
    )]
    TooLittleMemory {
        /// Name of the device.
        device: String,
        /// Bytes of the plan.
        needed: u64,
        /// Bytes that the device gives at once.
        available: u64,
    },
    /// A kernel did not compile, or is asked for more than the device can do at once.
    #[error("running kernel {kernel}: {reason}; update the driver, or use --backend cpu")]
    Kernel {
        /// Name of the kernel.
        kernel: &'static str,
        /// What the compiler or driver said.
        reason: String,
    },
    /// The driver refused something that it should be able to do.
    #[error("{doing}: the driver of {device} says {reason}; update it, or use --backend cpu")]
    Driver {
        /// What was being done.
        doing: &'static str,
        /// Name of the device.
        device: String,
        /// What the driver said.
        reason: String,
    },
    /// The device is gone, and its buffers with it: reset by its driver, unplugged, or suspended. The caller falls back
    /// to the CPU backend.
    #[error("the device was lost while {doing}: {reason}; the system log may know why")]
    Lost {
        /// What was being done.
        doing: &'static str,
        /// What the driver said.
        reason: String,
    },
}
