//! Recording and submitting work: one command buffer, one timeline.

use super::device::VulkanDevice;
use crate::splat::device::DeviceError;
use ash::vk;
use std::sync::Arc;

/// A submission that takes longer has hung. Software devices need seconds for a large step.
const PATIENCE_NS: u64 = 120_000_000_000;

/// The command buffer of an executor. Recording, submitting and waiting take no memory from Rust's heap.
pub(super) struct Commands {
    device: Arc<VulkanDevice>,
    pool: vk::CommandPool,
    buffer: vk::CommandBuffer,
    timeline: vk::Semaphore,
    /// Value of the timeline after everything that was submitted.
    submitted: u64,
    /// In a drill, the submissions that are left before the device pretends to be lost.
    left_in_drill: Option<u64>,
}

impl Commands {
    pub(super) fn new(device: &Arc<VulkanDevice>) -> Result<Self, DeviceError> {
        let mut commands = Self {
            device: Arc::clone(device),
            pool: vk::CommandPool::null(),
            buffer: vk::CommandBuffer::null(),
            timeline: vk::Semaphore::null(),
            submitted: 0,
            left_in_drill: None,
        };
        let raw = device.raw();
        let error = |code| device.error("setting up the command buffer", code);
        let pool = vk::CommandPoolCreateInfo::default().queue_family_index(device.compute_family());
        let mut timeline = vk::SemaphoreTypeCreateInfo::default().semaphore_type(vk::SemaphoreType::TIMELINE);
        let semaphore = vk::SemaphoreCreateInfo::default().push_next(&mut timeline);
        // SAFETY: the device is alive and has timeline semaphores; the pool is this object's own.
        unsafe {
            commands.pool = raw.create_command_pool(&pool, None).map_err(error)?;
            commands.timeline = raw.create_semaphore(&semaphore, None).map_err(error)?;
            let one = vk::CommandBufferAllocateInfo::default().command_pool(commands.pool).command_buffer_count(1);
            commands.buffer = raw.allocate_command_buffers(&one).map_err(error)?[0];
        }
        Ok(commands)
    }

    /// Pretends that the device is lost after `n_submissions` more.
    pub(super) fn lose_after(&mut self, n_submissions: u64) {
        self.left_in_drill = Some(n_submissions);
    }

    /// The command buffer, empty and ready to record, when the device is done with what it held.
    pub(super) fn begin(&mut self) -> Result<vk::CommandBuffer, DeviceError> {
        self.wait("waiting for the step before")?;
        let raw = self.device.raw();
        let error = |code| self.device.error("starting a command buffer", code);
        let info = vk::CommandBufferBeginInfo::default().flags(vk::CommandBufferUsageFlags::ONE_TIME_SUBMIT);
        // SAFETY: pool and buffer are this object's own, and the wait above says that the device has finished with them.
        unsafe {
            raw.reset_command_pool(self.pool, vk::CommandPoolResetFlags::empty()).map_err(error)?;
            raw.begin_command_buffer(self.buffer, &info).map_err(error)?;
        }
        Ok(self.buffer)
    }

    /// Hands what was recorded to the device.
    pub(super) fn submit(&mut self, doing: &'static str) -> Result<(), DeviceError> {
        let error = |code| self.device.error(doing, code);
        if let Some(left) = &mut self.left_in_drill {
            if *left == 0 {
                return Err(error(vk::Result::ERROR_DEVICE_LOST));
            }
            *left -= 1;
        }
        let value = self.submitted + 1;
        let values = [value];
        let mut timeline = vk::TimelineSemaphoreSubmitInfo::default().signal_semaphore_values(&values);
        let (buffers, semaphores) = ([self.buffer], [self.timeline]);
        let info =
            vk::SubmitInfo::default().command_buffers(&buffers).signal_semaphores(&semaphores).push_next(&mut timeline);
        let queue = self.device.queue().lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        // SAFETY: the buffer is in the recording state and this object's own, the queue is locked, and everything the
        // commands name belongs to the executor, which waits before it ends.
        unsafe {
            self.device.raw().end_command_buffer(self.buffer).map_err(error)?;
            self.device.raw().queue_submit(*queue, &[info], vk::Fence::null()).map_err(error)?;
        }
        self.submitted = value;
        Ok(())
    }

    /// Waits until the device has done everything that was submitted.
    pub(super) fn wait(&self, doing: &'static str) -> Result<(), DeviceError> {
        let (semaphores, values) = ([self.timeline], [self.submitted]);
        let info = vk::SemaphoreWaitInfo::default().semaphores(&semaphores).values(&values);
        // SAFETY: the semaphore is this object's own, and the value has been submitted.
        match unsafe { self.device.raw().wait_semaphores(&info, PATIENCE_NS) } {
            Ok(()) => Ok(()),
            // Whoever does not answer for so long is as good as lost.
            Err(vk::Result::TIMEOUT) => Err(self.device.error(doing, vk::Result::ERROR_DEVICE_LOST)),
            Err(code) => Err(self.device.error(doing, code)),
        }
    }
}

impl Drop for Commands {
    fn drop(&mut self) {
        let _ = self.wait("ending");
        // SAFETY: the device is done with the commands, or lost.
        unsafe {
            self.device.raw().destroy_semaphore(self.timeline, None);
            self.device.raw().destroy_command_pool(self.pool, None);
        }
    }
}
