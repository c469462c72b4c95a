//! What the machine's devices are and can do.

use super::choice::{DeviceInfo, DeviceKind};
use super::instance::{Instance, MIN_API_VERSION};
use super::spirv::KERNELS_USE_SUBGROUPS;
use crate::splat::device::DeviceError;
use ash::{ext, vk};
use std::ffi::CStr;

/// Subgroup sizes that the kernels work with.
const SUBGROUP_SIZES: std::ops::RangeInclusive<u32> = 4..=64;

/// What kernels that use subgroups ask of them.
const SUBGROUP_OPERATIONS: [(vk::SubgroupFeatureFlags, &str); 4] = [
    (vk::SubgroupFeatureFlags::BASIC, "subgroups"),
    (vk::SubgroupFeatureFlags::BALLOT, "subgroup ballots"),
    (vk::SubgroupFeatureFlags::ARITHMETIC, "subgroup arithmetic"),
    (vk::SubgroupFeatureFlags::SHUFFLE, "subgroup shuffles"),
];

/// Storage buffers that one kernel binds at most.
pub(super) const MAX_BINDINGS: u32 = 16;

/// Every device of this machine, usable or not.
///
/// # Errors
/// [`DeviceError::NoDevice`] without Vulkan, [`DeviceError::Driver`] when it does not work.
pub fn list_devices() -> Result<Vec<DeviceInfo>, DeviceError> {
    let instance = Instance::load()?;
    Ok(described(&instance)?.into_iter().map(|device| device.info).collect())
}

/// A device with everything that was asked about it.
pub(super) struct Described {
    pub(super) info: DeviceInfo,
    pub(super) raw: vk::PhysicalDevice,
    pub(super) limits: Limits,
    pub(super) compute_family: u32,
    /// `VK_EXT_external_memory_host` is there; with it the alignment of what can be imported.
    pub(super) import_alignment: Option<u64>,
}

/// The limits that the executor keeps.
#[derive(Debug, Clone, Copy)]
pub(super) struct Limits {
    pub(super) max_storage_bytes: u64,
    pub(super) max_allocation_bytes: u64,
    pub(super) max_groups: [u32; 3],
}

pub(super) fn described(instance: &Instance) -> Result<Vec<Described>, DeviceError> {
    let devices = instance.physical_devices()?;
    Ok((0..).zip(devices).map(|(number, raw)| describe(instance.raw(), number, raw)).collect())
}

fn describe(instance: &ash::Instance, number: u32, raw: vk::PhysicalDevice) -> Described {
    let mut subgroup = vk::PhysicalDeviceSubgroupProperties::default();
    let mut driver = vk::PhysicalDeviceDriverProperties::default();
    let mut maintenance = vk::PhysicalDeviceMaintenance3Properties::default();
    let mut properties = vk::PhysicalDeviceProperties2::default()
        .push_next(&mut subgroup)
        .push_next(&mut driver)
        .push_next(&mut maintenance);
    // SAFETY: `raw` is a device of this instance; the chain holds structures of Vulkan 1.1 and 1.2, which a device that
    // does not know them leaves as they are.
    unsafe { instance.get_physical_device_properties2(raw, &mut properties) };
    let properties = properties.properties;
    let max_allocation_bytes = maintenance.max_memory_allocation_size;
    // SAFETY: `raw` is a device of this instance.
    let memory = unsafe { instance.get_physical_device_memory_properties(raw) };
    let (heap_bytes, is_shared) = largest_heap(&memory);
    let kind = kind_of(properties.device_type);
    let limits = properties.limits;
    let compute_family = compute_family(instance, raw);
    let missing = missing(instance, raw, properties.api_version, &subgroup, &limits, compute_family);
    let info = DeviceInfo {
        number,
        name: text(properties.device_name_as_c_str()),
        kind,
        driver: [text(driver.driver_name_as_c_str()), text(driver.driver_info_as_c_str())].join(" "),
        api: (vk::api_version_major(properties.api_version), vk::api_version_minor(properties.api_version)),
        subgroup_size: subgroup.subgroup_size,
        heap_bytes,
        has_own_memory: kind != DeviceKind::Software && !is_shared,
        max_storage_bytes: u64::from(limits.max_storage_buffer_range),
        missing,
    };
    let limits = Limits {
        max_storage_bytes: u64::from(limits.max_storage_buffer_range),
        max_allocation_bytes,
        max_groups: limits.max_compute_work_group_count,
    };
    let import_alignment = import_alignment(instance, raw);
    Described { info, raw, limits, compute_family: compute_family.unwrap_or(0), import_alignment }
}

fn text(name: Result<&CStr, impl Sized>) -> String {
    name.map_or_else(|_| "unnamed".to_owned(), |name| name.to_string_lossy().into_owned())
}

fn kind_of(kind: vk::PhysicalDeviceType) -> DeviceKind {
    match kind {
        vk::PhysicalDeviceType::DISCRETE_GPU => DeviceKind::Discrete,
        vk::PhysicalDeviceType::INTEGRATED_GPU => DeviceKind::Integrated,
        vk::PhysicalDeviceType::VIRTUAL_GPU => DeviceKind::Virtual,
        vk::PhysicalDeviceType::CPU => DeviceKind::Software,
        _ => DeviceKind::Other,
    }
}

/// Bytes of the largest device-local heap, and whether the device shares it with the processor: then every heap is
/// device-local.
fn largest_heap(memory: &vk::PhysicalDeviceMemoryProperties) -> (u64, bool) {
    let heaps = memory.memory_heaps_as_slice();
    let is_local = |heap: &&vk::MemoryHeap| heap.flags.contains(vk::MemoryHeapFlags::DEVICE_LOCAL);
    let bytes = heaps.iter().filter(is_local).map(|heap| heap.size).max().unwrap_or(0);
    (bytes, heaps.iter().all(|heap| is_local(&heap)))
}

/// The queue family to compute with: one that does not draw, where there is one.
fn compute_family(instance: &ash::Instance, raw: vk::PhysicalDevice) -> Option<u32> {
    // SAFETY: `raw` is a device of this instance.
    let families = unsafe { instance.get_physical_device_queue_family_properties(raw) };
    let draws = |flags: vk::QueueFlags| flags.contains(vk::QueueFlags::GRAPHICS);
    let computing = (0..).zip(&families).filter(|(_, family)| family.queue_flags.contains(vk::QueueFlags::COMPUTE));
    computing.min_by_key(|(_, family)| draws(family.queue_flags)).map(|(index, _)| index)
}

/// What a device lacks, if anything.
fn missing(
    instance: &ash::Instance,
    raw: vk::PhysicalDevice,
    api_version: u32,
    subgroup: &vk::PhysicalDeviceSubgroupProperties<'_>,
    limits: &vk::PhysicalDeviceLimits,
    compute_family: Option<u32>,
) -> Option<&'static str> {
    if api_version < MIN_API_VERSION {
        return Some("Vulkan 1.2");
    }
    if compute_family.is_none() {
        return Some("compute queue");
    }
    let mut timeline = vk::PhysicalDeviceTimelineSemaphoreFeatures::default();
    let mut features = vk::PhysicalDeviceFeatures2::default().push_next(&mut timeline);
    // SAFETY: `raw` is a device of this instance and knows Vulkan 1.2, where the chained structure is from.
    unsafe { instance.get_physical_device_features2(raw, &mut features) };
    if timeline.timeline_semaphore == vk::FALSE {
        return Some("timeline semaphores");
    }
    if !KERNELS_USE_SUBGROUPS {
        return few_bindings(limits);
    }
    let in_compute = subgroup.supported_stages.contains(vk::ShaderStageFlags::COMPUTE);
    let absent = SUBGROUP_OPERATIONS.iter().find(|(flag, _)| !subgroup.supported_operations.contains(*flag));
    match absent {
        Some((_, name)) => Some(name),
        None if !in_compute => Some("subgroups in compute kernels"),
        None if !SUBGROUP_SIZES.contains(&subgroup.subgroup_size) => Some("subgroup size of 4 to 64"),
        None => few_bindings(limits),
    }
}

fn few_bindings(limits: &vk::PhysicalDeviceLimits) -> Option<&'static str> {
    (limits.max_per_stage_descriptor_storage_buffers < MAX_BINDINGS).then_some("16 storage buffers per kernel")
}

fn import_alignment(instance: &ash::Instance, raw: vk::PhysicalDevice) -> Option<u64> {
    // SAFETY: `raw` is a device of this instance.
    let extensions = unsafe { instance.enumerate_device_extension_properties(raw) }.ok()?;
    extensions.iter().find(|e| e.extension_name_as_c_str() == Ok(ext::external_memory_host::NAME))?;
    let mut host = vk::PhysicalDeviceExternalMemoryHostPropertiesEXT::default();
    let mut properties = vk::PhysicalDeviceProperties2::default().push_next(&mut host);
    // SAFETY: the device has the extension that the chained structure is from.
    unsafe { instance.get_physical_device_properties2(raw, &mut properties) };
    Some(host.min_imported_host_pointer_alignment)
}
