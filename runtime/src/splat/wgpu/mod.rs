//! Splatting through wgpu: the device programs on whatever API wgpu finds.

mod executor;

pub use executor::WgpuExecutor;

/// The device backend on wgpu.
pub type WgpuBackend = super::device::DeviceBackend<WgpuExecutor>;
