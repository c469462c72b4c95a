//! The connection to the Vulkan loader, and what its layers tell.

use super::choice::no_device;
use crate::splat::device::DeviceError;
use ash::{ext, vk};
use std::ffi::{CStr, c_void};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// When this is `1`, the validation layer watches every call and its messages reach the log.
pub const VALIDATION_VARIABLE: &str = "KILOGS_VULKAN_VALIDATION";

/// Debian: `vulkan-validationlayers`.
const VALIDATION_LAYER: &CStr = c"VK_LAYER_KHRONOS_validation";

/// Timeline semaphores and subgroup operations are part of Vulkan from here on.
pub(super) const MIN_API_VERSION: u32 = vk::API_VERSION_1_2;

/// Warnings and errors of the validation layer in this process.
static N_VALIDATION_MESSAGES: AtomicU32 = AtomicU32::new(0);

/// Warnings and errors of the validation layer in this process so far; a test demands that there are none.
pub fn validation_messages() -> u32 {
    N_VALIDATION_MESSAGES.load(Relaxed)
}

/// The validation layer was asked for.
pub(super) fn is_validation_wanted() -> bool {
    std::env::var_os(VALIDATION_VARIABLE).is_some_and(|value| value == "1")
}

/// An instance with its loader; both end with it.
pub(super) struct Instance {
    messenger: Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)>,
    raw: ash::Instance,
    /// The functions above live in the library that this holds.
    _entry: ash::Entry,
}

impl Instance {
    /// Loads Vulkan and, when asked for, its validation layer.
    ///
    /// # Errors
    /// [`DeviceError::NoDevice`] without a loader, [`DeviceError::Driver`] when it does not work.
    pub(super) fn load() -> Result<Self, DeviceError> {
        // SAFETY: loading runs the initializers of the system's Vulkan loader, a library that is made for this; nothing
        // of it is used after `_entry`, which is dropped last.
        let entry = unsafe { ash::Entry::load() }.map_err(|e| no_device(format!("there is no Vulkan loader ({e})")))?;
        let layers = layers(&entry);
        let extensions: &[*const std::ffi::c_char] =
            if layers.is_empty() { &[] } else { &[ext::debug_utils::NAME.as_ptr()] };
        let application = vk::ApplicationInfo::default()
            .application_name(c"kilogs")
            .engine_name(c"kilogs")
            .api_version(vk::API_VERSION_1_3);
        let checks = [vk::ValidationFeatureEnableEXT::SYNCHRONIZATION_VALIDATION];
        let mut features = vk::ValidationFeaturesEXT::default().enabled_validation_features(&checks);
        let mut info = vk::InstanceCreateInfo::default()
            .application_info(&application)
            .enabled_layer_names(&layers)
            .enabled_extension_names(extensions);
        if !layers.is_empty() {
            info = info.push_next(&mut features);
        }
        // SAFETY: `info` and everything it points to are alive; layer and extension were found to be there.
        let raw = unsafe { entry.create_instance(&info, None) }.map_err(|e| driver("creating a Vulkan instance", e))?;
        let messenger = if layers.is_empty() { None } else { messenger(&entry, &raw) };
        Ok(Self { messenger, raw, _entry: entry })
    }

    pub(super) fn raw(&self) -> &ash::Instance {
        &self.raw
    }

    /// All devices, in the loader's order.
    ///
    /// # Errors
    /// [`DeviceError::Driver`].
    pub(super) fn physical_devices(&self) -> Result<Vec<vk::PhysicalDevice>, DeviceError> {
        // SAFETY: the instance is alive.
        unsafe { self.raw.enumerate_physical_devices() }.map_err(|e| driver("listing the Vulkan devices", e))
    }
}

impl Drop for Instance {
    fn drop(&mut self) {
        // SAFETY: whoever made something of this instance holds it alive (`VulkanDevice` owns it and ends first).
        unsafe {
            if let Some((functions, messenger)) = self.messenger.take() {
                functions.destroy_debug_utils_messenger(messenger, None);
            }
            self.raw.destroy_instance(None);
        }
    }
}

/// The validation layer, when it is wanted and there.
fn layers(entry: &ash::Entry) -> Vec<*const std::ffi::c_char> {
    if !is_validation_wanted() {
        return vec![];
    }
    // SAFETY: the loader is alive.
    let present = unsafe { entry.enumerate_instance_layer_properties() }.unwrap_or_default();
    if present.iter().any(|layer| layer.layer_name_as_c_str() == Ok(VALIDATION_LAYER)) {
        log::info!("{VALIDATION_VARIABLE}: the Vulkan validation layer watches");
        return vec![VALIDATION_LAYER.as_ptr()];
    }
    log::warn!("{VALIDATION_VARIABLE}: there is no validation layer here; install vulkan-validationlayers");
    vec![]
}

fn messenger(
    entry: &ash::Entry,
    instance: &ash::Instance,
) -> Option<(ext::debug_utils::Instance, vk::DebugUtilsMessengerEXT)> {
    let functions = ext::debug_utils::Instance::new(entry, instance);
    use vk::{DebugUtilsMessageSeverityFlagsEXT as Severity, DebugUtilsMessageTypeFlagsEXT as Type};
    let info = vk::DebugUtilsMessengerCreateInfoEXT::default()
        .message_severity(Severity::ERROR | Severity::WARNING)
        .message_type(Type::GENERAL | Type::VALIDATION | Type::PERFORMANCE)
        .pfn_user_callback(Some(hand_to_log));
    // SAFETY: `info` is alive, and the callback needs nothing that could end before the messenger.
    match unsafe { functions.create_debug_utils_messenger(&info, None) } {
        Ok(messenger) => Some((functions, messenger)),
        Err(e) => {
            log::warn!("the Vulkan validation layer cannot speak ({e})");
            None
        }
    }
}

/// Called by the layer on whichever thread made the call that it has something to say about.
unsafe extern "system" fn hand_to_log(
    severity: vk::DebugUtilsMessageSeverityFlagsEXT,
    kind: vk::DebugUtilsMessageTypeFlagsEXT,
    data: *const vk::DebugUtilsMessengerCallbackDataEXT<'_>,
    _user: *mut c_void,
) -> vk::Bool32 {
    // Writing to the log allocates; under the validation layer nobody counts that.
    let _watched = crate::seal::lift();
    // SAFETY: the layer hands over a structure that is alive during the call, or null.
    let text = unsafe { data.as_ref().and_then(|data| data.message_as_c_str()) };
    let text = text.map_or_else(|| "no text".into(), CStr::to_string_lossy);
    if kind.contains(vk::DebugUtilsMessageTypeFlagsEXT::VALIDATION) {
        N_VALIDATION_MESSAGES.fetch_add(1, Relaxed);
    }
    #[cfg(test)]
    crate::splat::vulkan::testing::judge_message(&text);
    if severity.contains(vk::DebugUtilsMessageSeverityFlagsEXT::ERROR) {
        log::error!("Vulkan: {text}");
    } else {
        log::warn!("Vulkan: {text}");
    }
    vk::FALSE
}

/// A failure before there is a device.
fn driver(doing: &'static str, code: vk::Result) -> DeviceError {
    DeviceError::Driver { device: "this machine".to_owned(), doing, reason: code.to_string() }
}
