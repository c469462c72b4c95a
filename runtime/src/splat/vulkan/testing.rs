//! The device that tests run on. Without one, each test says that it was left out.

use super::{DeviceRequest, VulkanDevice, validation_messages};
use std::cell::Cell;
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

thread_local! {
    /// A test on this thread is about to do something wrong.
    static IS_PROVOKED: Cell<bool> = const { Cell::new(false) };
}

/// Messages of the validation layer end the tests, unless one was provoked.
pub(super) fn judge_message(text: &str) {
    if !IS_PROVOKED.get() {
        // Unwinding through the driver is not possible.
        eprintln!("the validation layer says: {text}");
        std::process::abort();
    }
}

/// Does something wrong on purpose; returns how many messages it was worth.
pub(super) fn provoke(wrong: impl FnOnce()) -> u32 {
    let before = validation_messages();
    IS_PROVOKED.set(true);
    wrong();
    IS_PROVOKED.set(false);
    validation_messages() - before
}
