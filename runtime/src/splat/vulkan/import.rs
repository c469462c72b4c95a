//! Host pages that the device reads where they lie, where it can.
//!
//! The camera process writes frames into shared memory that this process maps read-only. `VK_EXT_external_memory_host`
//! lets a device copy from there without the processor in between; drivers may refuse, and then the processor copies.

use super::device::{HostImport, VulkanDevice};
use ash::vk;
use std::marker::PhantomData;
use std::sync::Arc;

/// A range of host memory to upload from, in the best way that the device knows.
pub enum PageSource<'p> {
    /// The device reads the pages itself.
    Imported(ImportedPages<'p>),
    /// The processor copies them.
    Copied {
        /// The pages.
        pages: &'p [u8],
        /// Why the device does not read them.
        reason: &'static str,
    },
}

impl<'p> PageSource<'p> {
    /// Imports `pages` when the device allows it; never fails, because a copy is always possible.
    pub fn new(device: &Arc<VulkanDevice>, pages: &'p [u8]) -> Self {
        match import(device, pages) {
            Ok(imported) => Self::Imported(imported),
            Err(reason) => Self::Copied { pages, reason },
        }
    }

    /// Bytes of the range.
    pub fn bytes(&self) -> usize {
        match self {
            Self::Imported(pages) => pages.bytes,
            Self::Copied { pages, .. } => pages.len(),
        }
    }

    /// How uploads from here go, for the log and for reports.
    pub fn describe(&self) -> &'static str {
        match self {
            Self::Imported(_) => "zero-copy import",
            Self::Copied { reason, .. } => reason,
        }
    }
}

/// Pages that are known to the device. They are borrowed for as long as it may read them.
pub struct ImportedPages<'p> {
    device: Arc<VulkanDevice>,
    memory: vk::DeviceMemory,
    buffer: vk::Buffer,
    bytes: usize,
    pages: PhantomData<&'p [u8]>,
}

impl ImportedPages<'_> {
    pub(super) fn buffer(&self) -> vk::Buffer {
        self.buffer
    }
}

impl Drop for ImportedPages<'_> {
    fn drop(&mut self) {
        // SAFETY: `VulkanExecutor::upload_pages`, the only user, waits for its copy before it returns.
        unsafe {
            self.device.raw().destroy_buffer(self.buffer, None);
            self.device.raw().free_memory(self.memory, None);
        }
    }
}

const HANDLE: vk::ExternalMemoryHandleTypeFlags = vk::ExternalMemoryHandleTypeFlags::HOST_ALLOCATION_EXT;

fn import<'p>(device: &Arc<VulkanDevice>, pages: &'p [u8]) -> Result<ImportedPages<'p>, &'static str> {
    let HostImport { functions, alignment } = device.import().ok_or("copied: the device cannot import host memory")?;
    let (address, unit) = (pages.as_ptr().addr() as u64, *alignment);
    if pages.is_empty() || !address.is_multiple_of(unit) || !(pages.len() as u64).is_multiple_of(unit) {
        return Err("copied: the range is not whole pages");
    }
    let pointer = pages.as_ptr().cast_mut().cast();
    let mut host = vk::MemoryHostPointerPropertiesEXT::default();
    // SAFETY: the range is borrowed and thus mapped; the driver only asks what it is.
    unsafe {
        (functions.fp().get_memory_host_pointer_properties_ext)(device.raw().handle(), HANDLE, pointer, &mut host)
    }
    .result()
    .map_err(|_| "copied: the driver does not know this memory")?;
    let mut external = vk::ExternalMemoryBufferCreateInfo::default().handle_types(HANDLE);
    let info = vk::BufferCreateInfo::default()
        .size(pages.len() as u64)
        .usage(vk::BufferUsageFlags::TRANSFER_SRC)
        .push_next(&mut external);
    // SAFETY: the device is alive and has the extension; every object is kept in `imported` as soon as it exists.
    unsafe {
        let buffer = device.raw().create_buffer(&info, None).map_err(|_| "copied: the driver refused the buffer")?;
        let mut imported = ImportedPages {
            device: Arc::clone(device),
            memory: vk::DeviceMemory::null(),
            buffer,
            bytes: pages.len(),
            pages: PhantomData,
        };
        let needs = device.raw().get_buffer_memory_requirements(buffer);
        let memory_type = device
            .memory_type(needs.memory_type_bits & host.memory_type_bits, &[vk::MemoryPropertyFlags::empty()])
            .filter(|_| needs.size <= pages.len() as u64)
            .ok_or("copied: no kind of memory fits")?;
        let mut pointer = vk::ImportMemoryHostPointerInfoEXT::default().handle_type(HANDLE).host_pointer(pointer);
        let info = vk::MemoryAllocateInfo::default()
            .allocation_size(pages.len() as u64)
            .memory_type_index(memory_type)
            .push_next(&mut pointer);
        // The device never writes there: the buffer is a source of copies only.
        imported.memory =
            device.raw().allocate_memory(&info, None).map_err(|_| "copied: the driver refused to import the memory")?;
        device
            .raw()
            .bind_buffer_memory(buffer, imported.memory, 0)
            .map_err(|_| "copied: the driver refused to place the buffer")?;
        Ok(imported)
    }
}
