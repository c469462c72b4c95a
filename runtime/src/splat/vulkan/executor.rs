//! Runs programs on a Vulkan device.

use super::commands::Commands;
use super::device::VulkanDevice;
use super::import::PageSource;
use super::memory::{DeviceBlock, HostBlock};
use super::sets::Sets;
use crate::splat::Capacities;
use crate::splat::device::{Arena, DeviceError, EXCHANGE_BYTES, Executor};
use crate::splat::program::{Buffer, Part, Stage, WorkSize, Workgroups, buffer_plan, check_groups};
use ash::vk;
use std::sync::Arc;

/// Offsets of pieces in the exchange buffer are multiples of this.
const PIECE_ALIGNMENT: usize = 16;

/// When this is a number, the device pretends to be lost after so many submissions: for drills and tests.
pub const LOSS_DRILL_VARIABLE: &str = "KILOGS_VULKAN_LOSE_AFTER";

/// An executor with the buffers of one backend. After it is open, nothing allocates on the Rust side.
///
/// Fields end in the order in which they stand: first the wait for the device, then what it used.
pub struct VulkanExecutor {
    commands: Commands,
    sets: Sets,
    block: DeviceBlock,
    exchange: HostBlock,
    device: Arc<VulkanDevice>,
    /// The command buffer that is being recorded.
    recording: Option<vk::CommandBuffer>,
    /// Bytes of the exchange buffer that recorded copies read or write.
    n_exchanged: usize,
    /// Buffers that recorded copies touched since the last barrier, one bit each.
    touched: u64,
    /// A dispatch was recorded since the last barrier.
    has_dispatched: bool,
}

const _: () = assert!(Buffer::ALL.len() <= 64, "one bit per buffer");

impl VulkanExecutor {
    /// Takes all device memory for `capacities`, at most `cap_bytes` of it, and warms every kernel.
    ///
    /// # Errors
    /// [`DeviceError`] names the row that does not fit, or what the device lacks.
    pub fn new(device: &Arc<VulkanDevice>, capacities: &Capacities, cap_bytes: u64) -> Result<Self, DeviceError> {
        check_groups(capacities, device.limits().max_groups[0])?;
        let block = DeviceBlock::new(device, cap_bytes, &buffer_plan(capacities))?;
        let free_bytes = cap_bytes - block.arena().used_bytes();
        let exchange = HostBlock::new(device, free_bytes, "splat.device.exchange", EXCHANGE_BYTES as u64)?;
        let commands = Commands::new(device)?;
        let sets = Sets::new(device, &block)?;
        let mut executor = Self {
            commands,
            sets,
            block,
            exchange,
            device: Arc::clone(device),
            recording: None,
            n_exchanged: 0,
            touched: 0,
            has_dispatched: false,
        };
        executor.warm_up()?;
        if let Some(n) = std::env::var(LOSS_DRILL_VARIABLE).ok().and_then(|text| text.parse().ok()) {
            executor.lose_after(n);
        }
        Ok(executor)
    }

    /// Pretends that the device is lost after `n_submissions` more: for drills and tests.
    pub fn lose_after(&mut self, n_submissions: u64) {
        self.commands.lose_after(n_submissions);
    }

    /// What of the arena went to which buffer.
    pub fn arena(&self) -> &Arena {
        self.block.arena()
    }

    /// One workgroup of every kernel on zeroes, because some drivers compile on first use; then all buffers are zeroed,
    /// which also makes the driver find the memory now.
    fn warm_up(&mut self) -> Result<(), DeviceError> {
        self.zero_everything()?;
        for &part in Part::ALL {
            for (idx, stage) in part.stages().iter().enumerate() {
                self.dispatch(part, idx, stage, Workgroups::Direct(1))?;
            }
        }
        self.submit("warming up the kernels")?;
        self.zero_everything()?;
        self.submit("clearing the buffers")?;
        self.commands.wait("clearing the buffers")
    }

    fn zero_everything(&mut self) -> Result<(), DeviceError> {
        for &buffer in Buffer::ALL {
            let bytes = self.block.bytes(buffer as usize) as usize;
            self.clear(buffer, 0, bytes)?;
        }
        Ok(())
    }

    /// The command buffer that is being recorded; a new one sees everything that was submitted before.
    fn record(&mut self) -> Result<vk::CommandBuffer, DeviceError> {
        if let Some(buffer) = self.recording {
            return Ok(buffer);
        }
        let buffer = self.commands.begin()?;
        (self.n_exchanged, self.touched, self.has_dispatched) = (0, 0, false);
        self.barrier(buffer);
        self.recording = Some(buffer);
        Ok(buffer)
    }

    fn submit(&mut self, doing: &'static str) -> Result<(), DeviceError> {
        if self.recording.take().is_some() { self.commands.submit(doing) } else { Ok(()) }
    }

    /// What comes after sees what came before.
    fn barrier(&mut self, buffer: vk::CommandBuffer) {
        use vk::{AccessFlags as Access, PipelineStageFlags as Stages};
        let before = Stages::COMPUTE_SHADER | Stages::TRANSFER;
        let after = before | Stages::DRAW_INDIRECT;
        let writes = Access::SHADER_WRITE | Access::TRANSFER_WRITE;
        let reads = Access::SHADER_READ | Access::TRANSFER_READ | Access::UNIFORM_READ | Access::INDIRECT_COMMAND_READ;
        let memory = [vk::MemoryBarrier::default().src_access_mask(writes).dst_access_mask(writes | reads)];
        // SAFETY: `buffer` is this executor's own and being recorded.
        unsafe {
            self.device.raw().cmd_pipeline_barrier(
                buffer,
                before,
                after,
                vk::DependencyFlags::empty(),
                &memory,
                &[],
                &[],
            );
        }
        (self.touched, self.has_dispatched) = (0, false);
    }

    /// The command buffer, ready for a copy that touches `target`.
    fn record_copy(&mut self, target: Buffer) -> Result<vk::CommandBuffer, DeviceError> {
        let buffer = self.record()?;
        let bit = 1 << target as u32;
        if self.has_dispatched || self.touched & bit != 0 {
            self.barrier(buffer);
        }
        self.touched |= bit;
        Ok(buffer)
    }

    fn dispatch(&mut self, part: Part, idx: usize, stage: &Stage, groups: Workgroups) -> Result<(), DeviceError> {
        if groups == Workgroups::Direct(0) {
            return Ok(());
        }
        let buffer = self.record()?;
        if self.has_dispatched || self.touched != 0 {
            self.barrier(buffer);
        }
        self.has_dispatched = true;
        let (raw, kernels, kernel) = (self.device.raw(), self.device.kernels(), stage.kernel as usize);
        let sets = [self.sets.of(part, idx)];
        let compute = vk::PipelineBindPoint::COMPUTE;
        // SAFETY: `buffer` is being recorded; pipeline, layout and set belong together (same row of the kernel table) and
        // live until the executor has waited for the device; an indirect offset lies within the buffer, as the program
        // says.
        unsafe {
            raw.cmd_bind_pipeline(buffer, compute, kernels.pipeline(kernel));
            raw.cmd_bind_descriptor_sets(buffer, compute, kernels.layout(kernel), 0, &sets, &[]);
            match groups {
                Workgroups::Direct(n) => raw.cmd_dispatch(buffer, n, 1, 1),
                Workgroups::Indirect(offset) => {
                    raw.cmd_dispatch_indirect(buffer, self.block.buffer(Buffer::Dispatch as usize), u64::from(offset));
                }
            }
        }
        Ok(())
    }

    /// Room for up to `wanted` bytes in the exchange buffer: where it begins and how much it is.
    fn room(&mut self, wanted: usize) -> Result<(usize, usize), DeviceError> {
        if self.n_exchanged >= EXCHANGE_BYTES {
            self.submit("copying to the device")?;
        }
        self.record()?;
        let (start, len) = (self.n_exchanged, wanted.min(EXCHANGE_BYTES - self.n_exchanged));
        self.n_exchanged = (start + len).next_multiple_of(PIECE_ALIGNMENT);
        Ok((start, len))
    }

    fn is_inside(&self, buffer: Buffer, offset: usize, len: usize) -> bool {
        let bytes = self.block.bytes(buffer as usize);
        offset.is_multiple_of(4)
            && len.is_multiple_of(4)
            && offset.checked_add(len).is_some_and(|end| end as u64 <= bytes)
    }

    fn copy(&self, commands: vk::CommandBuffer, from: (vk::Buffer, usize), to: (vk::Buffer, usize), len: usize) {
        let region = [vk::BufferCopy { src_offset: from.1 as u64, dst_offset: to.1 as u64, size: len as u64 }];
        // SAFETY: the commands are being recorded; both buffers are this executor's own, and the callers have checked
        // that the ranges lie within.
        unsafe { self.device.raw().cmd_copy_buffer(commands, from.0, to.0, &region) };
    }
}

impl Executor for VulkanExecutor {
    fn upload(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &[u8]) -> Result<(), DeviceError> {
        assert!(self.is_inside(buffer, offset_bytes, bytes.len()), "an upload lies within its buffer");
        let (target, mut done) = (self.block.buffer(buffer as usize), 0);
        while done < bytes.len() {
            let (start, len) = self.room(bytes.len() - done)?;
            self.exchange.slice_mut(start, len).copy_from_slice(&bytes[done..done + len]);
            let commands = self.record_copy(buffer)?;
            self.copy(commands, (self.exchange.buffer(), start), (target, offset_bytes + done), len);
            done += len;
        }
        Ok(())
    }

    fn clear(&mut self, buffer: Buffer, offset_bytes: usize, len_bytes: usize) -> Result<(), DeviceError> {
        assert!(self.is_inside(buffer, offset_bytes, len_bytes), "what is cleared lies within its buffer");
        if len_bytes == 0 {
            return Ok(());
        }
        let commands = self.record_copy(buffer)?;
        let (target, offset, len) = (self.block.buffer(buffer as usize), offset_bytes as u64, len_bytes as u64);
        // SAFETY: the commands are being recorded, and the range was checked above.
        unsafe { self.device.raw().cmd_fill_buffer(commands, target, offset, len, 0) };
        Ok(())
    }

    fn run(&mut self, parts: &[Part], work: &WorkSize) -> Result<(), DeviceError> {
        for &part in parts {
            for (idx, stage) in part.stages().iter().enumerate() {
                self.dispatch(part, idx, stage, stage.workgroups(work))?;
            }
        }
        self.submit("running the kernels")
    }

    fn run_stage(&mut self, part: Part, stage: usize, work: &WorkSize) -> Result<(), DeviceError> {
        let found = &part.stages()[stage];
        self.dispatch(part, stage, found, found.workgroups(work))?;
        self.submit("running a kernel")
    }

    fn download(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &mut [u8]) -> Result<(), DeviceError> {
        assert!(self.is_inside(buffer, offset_bytes, bytes.len()), "a download lies within its buffer");
        let (source, mut done) = (self.block.buffer(buffer as usize), 0);
        while done < bytes.len() {
            let (start, len) = self.room(bytes.len() - done)?;
            let commands = self.record_copy(buffer)?;
            self.copy(commands, (source, offset_bytes + done), (self.exchange.buffer(), start), len);
            self.show_to_host(commands);
            self.submit("copying from the device")?;
            self.commands.wait("copying from the device")?;
            bytes[done..done + len].copy_from_slice(self.exchange.slice_mut(start, len));
            done += len;
        }
        Ok(())
    }

    fn device_name(&self) -> &str {
        &self.device.info().name
    }

    fn device_bytes(&self) -> usize {
        self.block.arena().used_bytes() as usize + EXCHANGE_BYTES
    }
}

impl VulkanExecutor {
    /// Uploads bytes `from..from + len` of `pages`, without the processor where they are imported, and waits until that is
    /// done: the pages may go away afterwards. Says how it was done.
    ///
    /// # Errors
    /// [`DeviceError::Lost`].
    pub fn upload_pages(
        &mut self,
        buffer: Buffer,
        offset_bytes: usize,
        pages: &PageSource<'_>,
        from: usize,
        len: usize,
    ) -> Result<&'static str, DeviceError> {
        assert!(self.is_inside(buffer, offset_bytes, len), "an upload lies within its buffer");
        assert!(from.checked_add(len).is_some_and(|end| end <= pages.bytes()), "and within its source");
        match pages {
            PageSource::Imported(imported) => {
                let target = self.block.buffer(buffer as usize);
                let commands = self.record_copy(buffer)?;
                self.copy(commands, (imported.buffer(), from), (target, offset_bytes), len);
            }
            PageSource::Copied { pages, .. } => self.upload(buffer, offset_bytes, &pages[from..from + len])?,
        }
        self.submit("copying from shared memory")?;
        self.commands.wait("copying from shared memory")?;
        Ok(pages.describe())
    }

    /// The host sees what copies wrote.
    fn show_to_host(&self, commands: vk::CommandBuffer) {
        let (from, to) = (vk::PipelineStageFlags::TRANSFER, vk::PipelineStageFlags::HOST);
        let memory = [vk::MemoryBarrier::default()
            .src_access_mask(vk::AccessFlags::TRANSFER_WRITE)
            .dst_access_mask(vk::AccessFlags::HOST_READ)];
        // SAFETY: the commands are this executor's own and being recorded.
        unsafe {
            self.device.raw().cmd_pipeline_barrier(commands, from, to, vk::DependencyFlags::empty(), &memory, &[], &[]);
        }
    }
}
