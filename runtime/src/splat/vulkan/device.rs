//! An opened device: everything that executors share.

use super::choice::{DeviceInfo, DeviceRequest, choose};
use super::instance::Instance;
use super::kernels::Kernels;
use super::listing::{Described, Limits, described};
use crate::seal;
use crate::splat::device::DeviceError;
use ash::{ext, vk};
use std::sync::Mutex;

/// An opened device with its compute queue. Executors hold it by reference count: what they made of it ends first.
pub struct VulkanDevice {
    raw: ash::Device,
    info: DeviceInfo,
    limits: Limits,
    memory: vk::PhysicalDeviceMemoryProperties,
    queue: Mutex<vk::Queue>,
    compute_family: u32,
    import: Option<HostImport>,
    kernels: Kernels,
    /// Ends last: the device is its child.
    _instance: Instance,
}

/// `VK_EXT_external_memory_host`: host pages can be read by the device where they lie.
pub(super) struct HostImport {
    pub(super) functions: ext::external_memory_host::Device,
    /// Addresses and lengths are multiples of this.
    pub(super) alignment: u64,
}

impl std::fmt::Debug for VulkanDevice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("VulkanDevice").field(&self.info).finish()
    }
}

impl VulkanDevice {
    /// Opens the device that `request` means.
    ///
    /// # Errors
    /// [`DeviceError`] says whether there is no loader, no such device, or a device that cannot be used.
    pub fn open(request: DeviceRequest) -> Result<Self, DeviceError> {
        let instance = Instance::load()?;
        let mut devices = described(&instance)?;
        let infos: Vec<_> = devices.iter().map(|device| device.info.clone()).collect();
        let number = choose(&infos, request)?.number as usize;
        let Described { info, raw: physical, limits, compute_family, import_alignment } = devices.swap_remove(number);
        let raw = create(&instance, physical, compute_family, import_alignment.is_some()).map_err(|code| {
            DeviceError::Driver { device: info.name.clone(), doing: "opening the device", reason: code.to_string() }
        })?;
        let kernels = match Kernels::new(&raw) {
            Ok(kernels) => kernels,
            Err(error) => {
                // SAFETY: nothing is left that was made of the device.
                unsafe { raw.destroy_device(None) };
                return Err(error);
            }
        };
        let import = import_alignment.map(|alignment| HostImport {
            functions: ext::external_memory_host::Device::new(instance.raw(), &raw),
            alignment,
        });
        // SAFETY: the device was created with one queue of this family.
        let queue = Mutex::new(unsafe { raw.get_device_queue(compute_family, 0) });
        // SAFETY: `physical` is a device of this instance.
        let memory = unsafe { instance.raw().get_physical_device_memory_properties(physical) };
        Ok(Self { raw, info, limits, memory, queue, compute_family, import, kernels, _instance: instance })
    }

    /// What it is and can do.
    pub fn info(&self) -> &DeviceInfo {
        &self.info
    }

    pub(super) fn raw(&self) -> &ash::Device {
        &self.raw
    }

    pub(super) fn limits(&self) -> &Limits {
        &self.limits
    }

    pub(super) fn queue(&self) -> &Mutex<vk::Queue> {
        &self.queue
    }

    pub(super) fn compute_family(&self) -> u32 {
        self.compute_family
    }

    pub(super) fn kernels(&self) -> &Kernels {
        &self.kernels
    }

    pub(super) fn import(&self) -> Option<&HostImport> {
        self.import.as_ref()
    }

    /// First memory type of `allowed` (a bit per type) that has all of the wanted properties; `wanted` in the order of
    /// preference.
    pub(super) fn memory_type(&self, allowed: u32, wanted: &[vk::MemoryPropertyFlags]) -> Option<u32> {
        let types = self.memory.memory_types_as_slice();
        wanted.iter().find_map(|&flags| {
            (0..)
                .zip(types)
                .find(|(i, kind)| allowed >> i & 1 == 1 && kind.property_flags.contains(flags))
                .map(|(i, _)| i)
        })
    }

    /// Bytes of the heap behind a memory type.
    pub(super) fn heap_bytes(&self, memory_type: u32) -> u64 {
        let heap = self.memory.memory_types_as_slice().get(memory_type as usize).map_or(0, |kind| kind.heap_index);
        self.memory.memory_heaps_as_slice().get(heap as usize).map_or(0, |heap| heap.size)
    }

    /// What a failed call means.
    pub(super) fn error(&self, doing: &'static str, code: vk::Result) -> DeviceError {
        // Once in a run: after an error the device is given up.
        let _allocates = seal::lift();
        match code {
            vk::Result::ERROR_DEVICE_LOST => DeviceError::Lost { doing, reason: self.info.name.clone() },
            code => DeviceError::Driver { doing, device: self.info.name.clone(), reason: code.to_string() },
        }
    }
}

impl Drop for VulkanDevice {
    fn drop(&mut self) {
        // SAFETY: everything that was made of the device held a reference to `self` and is gone. Waiting fails on a
        // device that is lost, which is idle too.
        unsafe {
            let _ = self.raw.device_wait_idle();
            self.kernels.destroy(&self.raw);
            self.raw.destroy_device(None);
        }
    }
}

fn create(
    instance: &Instance,
    physical: vk::PhysicalDevice,
    compute_family: u32,
    imports_host_memory: bool,
) -> Result<ash::Device, vk::Result> {
    let queues = [vk::DeviceQueueCreateInfo::default().queue_family_index(compute_family).queue_priorities(&[1.0])];
    let extensions: &[*const std::ffi::c_char] =
        if imports_host_memory { &[ext::external_memory_host::NAME.as_ptr()] } else { &[] };
    let mut timeline = vk::PhysicalDeviceTimelineSemaphoreFeatures::default().timeline_semaphore(true);
    // Every device has it: an index beyond a buffer reads something and writes nothing outside.
    let features = vk::PhysicalDeviceFeatures::default().robust_buffer_access(true);
    let info = vk::DeviceCreateInfo::default()
        .enabled_features(&features)
        .queue_create_infos(&queues)
        .enabled_extension_names(extensions)
        .push_next(&mut timeline);
    // SAFETY: `physical` is a device of this instance; family, feature and extension were found to be there.
    unsafe { instance.raw().create_device(physical, &info, None) }
}
