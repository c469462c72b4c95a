//! Device memory: two blocks, each taken once.

use super::device::VulkanDevice;
use crate::splat::MemoryRow;
use crate::splat::device::{Arena, ArenaFull, DeviceError};
use ash::vk;
use std::sync::Arc;

/// Everything kernels see: one block of device memory, one buffer per named range.
pub struct DeviceBlock {
    device: Arc<VulkanDevice>,
    memory: vk::DeviceMemory,
    buffers: Vec<vk::Buffer>,
    /// Bytes of each buffer, as asked for.
    bytes: Vec<u64>,
    arena: Arena,
}

const KERNEL_USAGE: vk::BufferUsageFlags = vk::BufferUsageFlags::from_raw(
    vk::BufferUsageFlags::STORAGE_BUFFER.as_raw()
        | vk::BufferUsageFlags::UNIFORM_BUFFER.as_raw()
        | vk::BufferUsageFlags::INDIRECT_BUFFER.as_raw()
        | vk::BufferUsageFlags::TRANSFER_SRC.as_raw()
        | vk::BufferUsageFlags::TRANSFER_DST.as_raw(),
);

impl DeviceBlock {
    /// Takes the memory for a buffer per row, in their order, of at most `cap_bytes` together.
    ///
    /// # Errors
    /// [`DeviceError::ArenaFull`] and [`DeviceError::BufferTooLarge`] name the row; [`DeviceError::TooLittleMemory`] when the
    /// device has less than the plan.
    pub fn new(device: &Arc<VulkanDevice>, cap_bytes: u64, rows: &[MemoryRow]) -> Result<Self, DeviceError> {
        let limit = device.limits().max_storage_bytes;
        if let Some(large) = rows.iter().find(|row| row.bytes() as u64 > limit) {
            let (name, bytes) = (large.name, large.bytes());
            return Err(DeviceError::BufferTooLarge { name, bytes, limit: limit as usize });
        }
        let mut block = Self {
            device: Arc::clone(device),
            memory: vk::DeviceMemory::null(),
            buffers: Vec::with_capacity(rows.len()),
            bytes: rows.iter().map(|row| row.bytes() as u64).collect(),
            arena: Arena::new(cap_bytes),
        };
        let mut allowed_types = u32::MAX;
        for row in rows {
            let (buffer, needs) = create_buffer(device, row.bytes() as u64, KERNEL_USAGE)?;
            block.buffers.push(buffer);
            allowed_types &= needs.memory_type_bits;
            block.arena.reserve(row.name, needs.size, needs.alignment)?;
        }
        let wanted = [vk::MemoryPropertyFlags::DEVICE_LOCAL, vk::MemoryPropertyFlags::empty()];
        block.memory = allocate(device, block.arena.used_bytes(), allowed_types, &wanted)?;
        for (&buffer, range) in block.buffers.iter().zip(block.arena.ranges()) {
            bind(device, buffer, block.memory, range.offset)?;
        }
        Ok(block)
    }

    /// The buffer of row `idx`.
    pub(super) fn buffer(&self, idx: usize) -> vk::Buffer {
        self.buffers[idx]
    }

    /// Bytes of the buffer of row `idx`.
    pub(super) fn bytes(&self, idx: usize) -> u64 {
        self.bytes[idx]
    }

    /// Bytes that were taken, and from which rows.
    pub fn arena(&self) -> &Arena {
        &self.arena
    }
}

impl Drop for DeviceBlock {
    fn drop(&mut self) {
        // SAFETY: the executor that owns the block has waited for the device to be done with it.
        unsafe {
            self.buffers.iter().for_each(|&buffer| self.device.raw().destroy_buffer(buffer, None));
            self.device.raw().free_memory(self.memory, None);
        }
    }
}

/// Where host and device exchange bytes: one block of memory that both see, mapped for as long as it lives.
pub struct HostBlock {
    device: Arc<VulkanDevice>,
    memory: vk::DeviceMemory,
    buffer: vk::Buffer,
    bytes: u64,
    mapped: std::ptr::NonNull<u8>,
}

// SAFETY: the mapping is memory like any other and belongs to this block alone; nothing is tied to the thread that made it.
unsafe impl Send for HostBlock {}

impl HostBlock {
    /// Takes `bytes` of memory, of at most `cap_bytes`, for `row`.
    ///
    /// # Errors
    /// [`DeviceError::ArenaFull`] when the cap is lower, [`DeviceError::TooLittleMemory`] when the device has less.
    pub fn new(device: &Arc<VulkanDevice>, cap_bytes: u64, row: &'static str, bytes: u64) -> Result<Self, DeviceError> {
        if bytes > cap_bytes {
            return Err(ArenaFull { row, needed_bytes: bytes, free_bytes: cap_bytes, cap_bytes }.into());
        }
        let usage = vk::BufferUsageFlags::TRANSFER_SRC | vk::BufferUsageFlags::TRANSFER_DST;
        let (buffer, needs) = create_buffer(device, bytes, usage)?;
        let coherent = vk::MemoryPropertyFlags::HOST_VISIBLE | vk::MemoryPropertyFlags::HOST_COHERENT;
        let wanted = [coherent | vk::MemoryPropertyFlags::HOST_CACHED, coherent];
        let mut block = Self {
            device: Arc::clone(device),
            memory: vk::DeviceMemory::null(),
            buffer,
            bytes,
            mapped: std::ptr::NonNull::dangling(),
        };
        block.memory = allocate(device, needs.size, needs.memory_type_bits, &wanted)?;
        bind(device, buffer, block.memory, 0)?;
        // SAFETY: the memory is host-visible, not mapped yet, and as large as asked for.
        let mapped = unsafe { device.raw().map_memory(block.memory, 0, vk::WHOLE_SIZE, vk::MemoryMapFlags::empty()) };
        let mapped = mapped.map_err(|code| device.error("mapping the exchange buffer", code))?;
        let null = || device.error("mapping the exchange buffer", vk::Result::ERROR_MEMORY_MAP_FAILED);
        block.mapped = std::ptr::NonNull::new(mapped.cast()).ok_or_else(null)?;
        Ok(block)
    }

    pub(super) fn buffer(&self) -> vk::Buffer {
        self.buffer
    }

    /// Bytes `offset..offset + len`; the device must not be using them.
    pub(super) fn slice_mut(&mut self, offset: usize, len: usize) -> &mut [u8] {
        assert!(offset.checked_add(len).is_some_and(|end| end as u64 <= self.bytes), "inside the exchange buffer");
        // SAFETY: `mapped` is valid for `bytes` bytes and the range lies within; `self` is borrowed uniquely, and the
        // executor waits for its commands before it comes here.
        unsafe { std::slice::from_raw_parts_mut(self.mapped.as_ptr().add(offset), len) }
    }
}

impl Drop for HostBlock {
    fn drop(&mut self) {
        // SAFETY: the executor that owns the block has waited for the device to be done with it. Freeing unmaps.
        unsafe {
            self.device.raw().destroy_buffer(self.buffer, None);
            self.device.raw().free_memory(self.memory, None);
        }
    }
}

fn create_buffer(
    device: &VulkanDevice,
    bytes: u64,
    usage: vk::BufferUsageFlags,
) -> Result<(vk::Buffer, vk::MemoryRequirements), DeviceError> {
    let info = vk::BufferCreateInfo::default().size(bytes.max(4)).usage(usage).sharing_mode(vk::SharingMode::EXCLUSIVE);
    // SAFETY: the device is alive and `info` complete.
    let buffer = unsafe { device.raw().create_buffer(&info, None) };
    let buffer = buffer.map_err(|code| device.error("creating a buffer", code))?;
    // SAFETY: the buffer was just made of this device.
    Ok((buffer, unsafe { device.raw().get_buffer_memory_requirements(buffer) }))
}

fn allocate(
    device: &VulkanDevice,
    bytes: u64,
    allowed_types: u32,
    wanted: &[vk::MemoryPropertyFlags],
) -> Result<vk::DeviceMemory, DeviceError> {
    let none = || device.error("choosing a kind of memory", vk::Result::ERROR_FEATURE_NOT_PRESENT);
    let memory_type = device.memory_type(allowed_types, wanted).ok_or_else(none)?;
    let available = device.heap_bytes(memory_type).min(device.limits().max_allocation_bytes);
    let too_little = || DeviceError::TooLittleMemory { device: device.info().name.clone(), needed: bytes, available };
    if bytes > available {
        return Err(too_little());
    }
    let info = vk::MemoryAllocateInfo::default().allocation_size(bytes.max(4)).memory_type_index(memory_type);
    // SAFETY: the device is alive, the type is one of its own and the size within its heap.
    match unsafe { device.raw().allocate_memory(&info, None) } {
        Ok(memory) => Ok(memory),
        Err(vk::Result::ERROR_OUT_OF_DEVICE_MEMORY | vk::Result::ERROR_OUT_OF_HOST_MEMORY) => Err(too_little()),
        Err(code) => Err(device.error("taking memory", code)),
    }
}

fn bind(device: &VulkanDevice, buffer: vk::Buffer, memory: vk::DeviceMemory, offset: u64) -> Result<(), DeviceError> {
    // SAFETY: buffer and memory are of this device, the buffer has no memory yet, and its range lies inside: the arena
    // cut it by the driver's own size and alignment.
    unsafe { device.raw().bind_buffer_memory(buffer, memory, offset) }
        .map_err(|code| device.error("placing a buffer", code))
}
