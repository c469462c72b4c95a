//! What each stage of each part is bound to, written once.

use super::device::VulkanDevice;
use super::memory::DeviceBlock;
use crate::splat::device::DeviceError;
use crate::splat::program::{Buffer, Part, Stage};
use ash::vk;
use std::sync::Arc;

/// One descriptor set per stage.
pub(super) struct Sets {
    device: Arc<VulkanDevice>,
    pool: vk::DescriptorPool,
    /// By part, then by stage.
    sets: Vec<Vec<vk::DescriptorSet>>,
}

impl Sets {
    /// Binds every stage to its buffers in `block`.
    pub(super) fn new(device: &Arc<VulkanDevice>, block: &DeviceBlock) -> Result<Self, DeviceError> {
        let stages = || Part::ALL.iter().flat_map(|part| part.stages());
        let n_sets = stages().count() as u32;
        let n_storage: u32 = stages().map(|stage| stage.buffers.len() as u32).sum();
        let size = |ty, descriptor_count: u32| vk::DescriptorPoolSize { ty, descriptor_count: descriptor_count.max(1) };
        let sizes =
            [size(vk::DescriptorType::UNIFORM_BUFFER, n_sets), size(vk::DescriptorType::STORAGE_BUFFER, n_storage)];
        let info = vk::DescriptorPoolCreateInfo::default().max_sets(n_sets.max(1)).pool_sizes(&sizes);
        // SAFETY: the device is alive and `info` complete.
        let pool = unsafe { device.raw().create_descriptor_pool(&info, None) };
        let pool = pool.map_err(|code| device.error("binding the buffers", code))?;
        let mut sets = Self { device: Arc::clone(device), pool, sets: Vec::with_capacity(Part::ALL.len()) };
        for part in Part::ALL {
            let of_part: Result<Vec<_>, _> = part.stages().iter().map(|stage| sets.bound(stage, block)).collect();
            sets.sets.push(of_part?);
        }
        Ok(sets)
    }

    fn bound(&self, stage: &Stage, block: &DeviceBlock) -> Result<vk::DescriptorSet, DeviceError> {
        let layouts = [self.device.kernels().set_layout(stage.kernel as usize)];
        let info = vk::DescriptorSetAllocateInfo::default().descriptor_pool(self.pool).set_layouts(&layouts);
        // SAFETY: pool and layout are of this device, and the pool has room for every stage.
        let set = unsafe { self.device.raw().allocate_descriptor_sets(&info) };
        let set = set.map_err(|code| self.device.error("binding the buffers", code))?[0];
        let buffers: Vec<_> = std::iter::once(&Buffer::View)
            .chain(stage.buffers)
            .map(|&buffer| {
                let range = block.bytes(buffer as usize);
                [vk::DescriptorBufferInfo { buffer: block.buffer(buffer as usize), offset: 0, range }]
            })
            .collect();
        let writes: Vec<_> = (0..)
            .zip(&buffers)
            .map(|(binding, info)| {
                let kind =
                    if binding == 0 { vk::DescriptorType::UNIFORM_BUFFER } else { vk::DescriptorType::STORAGE_BUFFER };
                vk::WriteDescriptorSet::default()
                    .dst_set(set)
                    .dst_binding(binding)
                    .descriptor_type(kind)
                    .buffer_info(info)
            })
            .collect();
        // SAFETY: the set was just made and is in no command; the buffers live as long as the executor that owns both.
        unsafe { self.device.raw().update_descriptor_sets(&writes, &[]) };
        Ok(set)
    }

    /// The set of stage `stage` of `part`.
    pub(super) fn of(&self, part: Part, stage: usize) -> vk::DescriptorSet {
        self.sets[part as usize][stage]
    }
}

impl Drop for Sets {
    fn drop(&mut self) {
        // SAFETY: the executor that owns the sets has waited for the device to be done with them.
        unsafe { self.device.raw().destroy_descriptor_pool(self.pool, None) };
    }
}
