//! The device that tests run on. Without one, each test says that it was left out.

use super::{DeviceRequest, VulkanDevice};
use std::sync::{Arc, LazyLock};

/// When this is `1`, a test that finds no device fails.
const REQUIRE_VARIABLE: &str = "KILOGS_REQUIRE_VULKAN";

/// One device for all tests of this process: opening one compiles every kernel.
static DEVICE: LazyLock<Option<Arc<VulkanDevice>>> = LazyLock::new(|| match VulkanDevice::open(DeviceRequest::Any) {
    Ok(device) => {
        eprintln!("Vulkan tests run on {}", device.info());
        Some(Arc::new(device))
    }
    Err(error) => {
        eprintln!("skipped, tests of the Vulkan device: {error}");
        None
    }
});

/// The device, or `None` where there is none and none is required.
pub(crate) fn device() -> Option<Arc<VulkanDevice>> {
    let is_required = std::env::var_os(REQUIRE_VARIABLE).is_some_and(|value| value == "1");
    assert!(DEVICE.is_some() || !is_required, "{REQUIRE_VARIABLE}=1, and there is no Vulkan device");
    DEVICE.clone()
}
