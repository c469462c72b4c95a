//! The devices to test on: whatever is there, and a word about what is not.

use crate::splat::device::DeviceError;
use crate::splat::wgpu::{WgpuBackend, WgpuExecutor};
use crate::splat::{Capacities, SplatBackend};

/// Memory that a test may take.
const CAP_BYTES: usize = 1 << 30;

/// Calls `check` with a backend of every device API that is present; without a device says so, or fails when
/// `KILOGS_REQUIRE_VULKAN=1`.
pub fn on_every_device(capacities: Capacities, mut check: impl FnMut(&str, &mut dyn SplatBackend)) {
    let opened = WgpuExecutor::open(&capacities, CAP_BYTES).and_then(|e| WgpuBackend::new(capacities, e));
    match opened {
        Ok(mut backend) => check("wgpu", &mut backend),
        Err(DeviceError::NoDevice { api, reason }) => skip(api, &reason),
        Err(error) => panic!("{error}"),
    }
}

fn skip(api: &str, reason: &str) {
    println!("skipped: no {api} adapter ({reason})");
    let required = std::env::var_os("KILOGS_REQUIRE_VULKAN").is_some_and(|v| v == "1");
    assert!(!required, "KILOGS_REQUIRE_VULKAN=1 and no {api} adapter: {reason}");
}
