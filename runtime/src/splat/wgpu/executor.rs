//! Runs the device programs with wgpu, which allocates a little of its own for every submission.

use crate::splat::device::{Arena, DeviceError, Executor};
#[cfg(test)]
use crate::splat::kernels::Kernel;
use crate::splat::kernels::{Access, KERNELS, KernelSpec};
use crate::splat::program::{Buffer, Part, Stage, WorkSize, Workgroups, buffer_plan, check_groups};
use crate::splat::{Capacities, MemoryRow};
use std::sync::{Arc, Mutex};

/// A wgpu device with the buffers and pipelines of the device programs.
pub struct WgpuExecutor {
    device: wgpu::Device,
    queue: wgpu::Queue,
    pipelines: Vec<wgpu::ComputePipeline>,
    buffers: Vec<wgpu::Buffer>,
    /// One bind group per stage, part by part.
    bind_groups: Vec<Vec<wgpu::BindGroup>>,
    /// Where downloads land; grows to the largest one.
    landing: wgpu::Buffer,
    failure: Arc<Mutex<Option<String>>>,
    name: String,
    device_bytes: usize,
    /// Uploads since the last submission that was for uploads alone.
    n_pending: usize,
}

/// Uploads that are collected before they are submitted: wgpu keeps them all, and searches them for every other one.
const MAX_PENDING: usize = 64;

impl WgpuExecutor {
    /// Opens the best adapter, compiles all kernels and creates all buffers.
    ///
    /// # Errors
    /// [`DeviceError`]: no adapter, a buffer over the adapter's limit, all buffers over `cap_bytes`, a kernel that does
    /// not compile.
    pub fn open(capacities: &Capacities, cap_bytes: usize) -> Result<Self, DeviceError> {
        let plan = buffer_plan(capacities);
        let mut arena = Arena::new(cap_bytes as u64);
        for row in &plan {
            arena.reserve(row.name, row.bytes() as u64, 16)?;
        }
        let device_bytes = arena.used_bytes() as usize;
        let adapter = best_adapter()?;
        let limits = adapter.limits();
        check_groups(capacities, limits.max_compute_workgroups_per_dimension)?;
        check_limits(&plan, &limits)?;
        let descriptor = wgpu::DeviceDescriptor { required_limits: limits, ..wgpu::DeviceDescriptor::default() };
        let (device, queue) =
            pollster::block_on(adapter.request_device(&descriptor)).map_err(|e| no_device(e.to_string()))?;
        let failure = Arc::new(Mutex::new(None));
        watch(&device, &failure);
        let buffers: Vec<_> = plan.iter().zip(Buffer::ALL).map(|(row, &b)| create_buffer(&device, row, b)).collect();
        let layouts: Vec<_> = KERNELS.iter().map(|spec| bind_group_layout(&device, spec)).collect();
        let mut pipelines = Vec::with_capacity(KERNELS.len());
        for (spec, layout) in KERNELS.iter().zip(&layouts) {
            pipelines.push(compile(&device, spec.name, spec.wgsl(), layout));
            if let Some(reason) = take_failure(&failure) {
                return Err(DeviceError::Kernel { kernel: spec.name, reason });
            }
        }
        let bind_groups = Part::ALL.iter().map(|part| {
            part.stages().iter().map(|s| bind(&device, &layouts[s.kernel as usize], &buffers, s)).collect()
        });
        let bind_groups = bind_groups.collect();
        let landing = create_landing(&device, 16);
        let name = adapter.get_info().name;
        Ok(Self { device, queue, pipelines, buffers, bind_groups, landing, failure, name, device_bytes, n_pending: 0 })
    }

    /// Name of the best adapter, and whether it has memory of its own.
    ///
    /// # Errors
    /// [`DeviceError::NoDevice`].
    pub fn describe() -> Result<(String, bool), DeviceError> {
        let info = best_adapter()?.get_info();
        Ok((info.name, info.device_type == wgpu::DeviceType::DiscreteGpu))
    }

    /// Runs another text in place of a kernel's own, for tests that must notice.
    #[cfg(test)]
    pub(in crate::splat) fn replace_kernel(&mut self, kernel: Kernel, wgsl: String) -> Result<(), DeviceError> {
        let spec = kernel.spec();
        let layout = bind_group_layout(&self.device, spec);
        self.pipelines[kernel as usize] = compile(&self.device, spec.name, wgsl, &layout);
        self.check("replacing a kernel")
    }

    fn check(&self, doing: &'static str) -> Result<(), DeviceError> {
        match take_failure(&self.failure) {
            Some(reason) => Err(DeviceError::Lost { doing, reason }),
            None => Ok(()),
        }
    }

    fn submit(&mut self, stages: impl Iterator<Item = (Part, usize)>, work: &WorkSize) -> Result<(), DeviceError> {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        {
            let mut pass = encoder.begin_compute_pass(&wgpu::ComputePassDescriptor::default());
            stages.for_each(|(part, stage)| self.record(&mut pass, part, stage, work));
        }
        self.queue.submit([encoder.finish()]);
        self.check("running kernels")
    }

    fn record(&self, pass: &mut wgpu::ComputePass<'_>, part: Part, stage: usize, work: &WorkSize) {
        let kernel = part.stages()[stage].kernel;
        let workgroups = part.stages()[stage].workgroups(work);
        if workgroups == Workgroups::Direct(0) {
            return;
        }
        pass.set_pipeline(&self.pipelines[kernel as usize]);
        pass.set_bind_group(0, &self.bind_groups[part as usize][stage], &[]);
        match workgroups {
            Workgroups::Direct(n) => pass.dispatch_workgroups(n, 1, 1),
            Workgroups::Indirect(offset_bytes) => {
                let counts = &self.buffers[Buffer::Dispatch as usize];
                pass.dispatch_workgroups_indirect(counts, u64::from(offset_bytes));
            }
        }
    }
}

fn best_adapter() -> Result<wgpu::Adapter, DeviceError> {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    // A development build would watch every call wherever the validation layer is installed, and take minutes.
    descriptor.flags = wgpu::InstanceFlags::empty().with_env();
    let instance = wgpu::Instance::new(descriptor);
    let options = wgpu::RequestAdapterOptions {
        power_preference: wgpu::PowerPreference::HighPerformance,
        ..wgpu::RequestAdapterOptions::default()
    };
    pollster::block_on(instance.request_adapter(&options)).map_err(|e| no_device(e.to_string()))
}

fn no_device(reason: String) -> DeviceError {
    DeviceError::NoDevice { api: "wgpu", reason }
}

fn check_limits(plan: &[MemoryRow], limits: &wgpu::Limits) -> Result<(), DeviceError> {
    let limit = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size) as usize;
    match plan.iter().find(|row| row.bytes() > limit) {
        Some(row) => Err(DeviceError::BufferTooLarge { name: row.name, bytes: row.bytes(), limit }),
        None => Ok(()),
    }
}

/// Keeps the first error that nobody asked for.
fn watch(device: &wgpu::Device, failure: &Arc<Mutex<Option<String>>>) {
    let keep = |failure: &Arc<Mutex<Option<String>>>| {
        let failure = failure.clone();
        move |message: String| {
            if let Ok(mut found) = failure.lock() {
                found.get_or_insert(message);
            }
        }
    };
    let (on_error, on_loss) = (keep(failure), keep(failure));
    device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| on_error(error.to_string())));
    device.set_device_lost_callback(move |reason, message| {
        // Dropping the device is not an error.
        if reason != wgpu::DeviceLostReason::Destroyed {
            on_loss(message);
        }
    });
}

fn take_failure(failure: &Mutex<Option<String>>) -> Option<String> {
    failure.lock().ok().and_then(|mut found| found.take())
}

fn create_buffer(device: &wgpu::Device, row: &MemoryRow, buffer: Buffer) -> wgpu::Buffer {
    let role = match buffer {
        Buffer::View => wgpu::BufferUsages::UNIFORM,
        Buffer::Dispatch => wgpu::BufferUsages::STORAGE | wgpu::BufferUsages::INDIRECT,
        _ => wgpu::BufferUsages::STORAGE,
    };
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some(row.name),
        size: row.bytes() as u64,
        usage: role | wgpu::BufferUsages::COPY_DST | wgpu::BufferUsages::COPY_SRC,
        mapped_at_creation: false,
    })
}

fn create_landing(device: &wgpu::Device, bytes: usize) -> wgpu::Buffer {
    device.create_buffer(&wgpu::BufferDescriptor {
        label: Some("splat.device.landing"),
        size: bytes as u64,
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    })
}

fn bind_group_layout(device: &wgpu::Device, spec: &KernelSpec) -> wgpu::BindGroupLayout {
    let entry = |binding: usize, ty: wgpu::BufferBindingType| wgpu::BindGroupLayoutEntry {
        binding: binding as u32,
        visibility: wgpu::ShaderStages::COMPUTE,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    };
    let mut entries = vec![entry(0, wgpu::BufferBindingType::Uniform)];
    entries.extend(spec.bindings.iter().enumerate().map(|(i, binding)| {
        entry(i + 1, wgpu::BufferBindingType::Storage { read_only: binding.access == Access::Read })
    }));
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor { label: Some(spec.name), entries: &entries })
}

fn compile(device: &wgpu::Device, name: &str, wgsl: String, layout: &wgpu::BindGroupLayout) -> wgpu::ComputePipeline {
    let module = device.create_shader_module(wgpu::ShaderModuleDescriptor {
        label: Some(name),
        source: wgpu::ShaderSource::Wgsl(wgsl.into()),
    });
    let layout = device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
        label: Some(name),
        bind_group_layouts: &[Some(layout)],
        immediate_size: 0,
    });
    device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
        label: Some(name),
        layout: Some(&layout),
        module: &module,
        entry_point: Some("main"),
        // Every kernel writes its shared memory before it reads it.
        compilation_options: wgpu::PipelineCompilationOptions {
            zero_initialize_workgroup_memory: false,
            ..wgpu::PipelineCompilationOptions::default()
        },
        cache: None,
    })
}

fn bind(
    device: &wgpu::Device,
    layout: &wgpu::BindGroupLayout,
    buffers: &[wgpu::Buffer],
    stage: &Stage,
) -> wgpu::BindGroup {
    let bound = core::iter::once(&Buffer::View).chain(stage.buffers);
    let entries: Vec<_> = bound
        .enumerate()
        .map(|(i, &buffer)| wgpu::BindGroupEntry {
            binding: i as u32,
            resource: buffers[buffer as usize].as_entire_binding(),
        })
        .collect();
    let label = Some(stage.kernel.spec().name);
    device.create_bind_group(&wgpu::BindGroupDescriptor { label, layout, entries: &entries })
}

impl Executor for WgpuExecutor {
    fn upload(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &[u8]) -> Result<(), DeviceError> {
        self.queue.write_buffer(&self.buffers[buffer as usize], offset_bytes as u64, bytes);
        self.n_pending += 1;
        if self.n_pending >= MAX_PENDING {
            self.n_pending = 0;
            self.queue.submit([]);
        }
        self.check("uploading")
    }

    fn clear(&mut self, buffer: Buffer, offset_bytes: usize, len_bytes: usize) -> Result<(), DeviceError> {
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        encoder.clear_buffer(&self.buffers[buffer as usize], offset_bytes as u64, Some(len_bytes as u64));
        self.queue.submit([encoder.finish()]);
        self.check("clearing a buffer")
    }

    fn run(&mut self, parts: &[Part], work: &WorkSize) -> Result<(), DeviceError> {
        let stages = parts.iter().flat_map(|&part| (0..part.stages().len()).map(move |stage| (part, stage)));
        self.submit(stages, work)
    }

    fn run_stage(&mut self, part: Part, stage: usize, work: &WorkSize) -> Result<(), DeviceError> {
        self.submit(core::iter::once((part, stage)), work)
    }

    fn download(&mut self, buffer: Buffer, offset_bytes: usize, bytes: &mut [u8]) -> Result<(), DeviceError> {
        let len = bytes.len() as u64;
        if self.landing.size() < len {
            self.landing = create_landing(&self.device, bytes.len());
        }
        let mut encoder = self.device.create_command_encoder(&wgpu::CommandEncoderDescriptor::default());
        let from = &self.buffers[buffer as usize];
        encoder.copy_buffer_to_buffer(from, offset_bytes as u64, &self.landing, 0, len);
        self.queue.submit([encoder.finish()]);
        let lost = |reason: String| DeviceError::Lost { doing: "downloading", reason };
        self.landing.map_async(wgpu::MapMode::Read, 0..len, |_| ());
        self.device.poll(wgpu::PollType::wait_indefinitely()).map_err(|e| lost(e.to_string()))?;
        self.check("downloading")?;
        let view = self.landing.get_mapped_range(0..len).map_err(|e| lost(e.to_string()))?;
        bytes.copy_from_slice(&view);
        drop(view);
        self.landing.unmap();
        Ok(())
    }

    fn device_name(&self) -> &str {
        &self.name
    }

    fn device_bytes(&self) -> usize {
        self.device_bytes
    }
}
