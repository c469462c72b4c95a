//! Compiled kernels: one pipeline for each row of the kernel table.

use super::spirv::KERNEL_SPIRV;
use crate::splat::device::DeviceError;
use crate::splat::kernels::{KERNELS, KernelSpec};
use ash::vk;

/// Pipelines of all kernels, in the order of the table. Owned by the device, which ends them.
pub(super) struct Kernels {
    set_layouts: Vec<vk::DescriptorSetLayout>,
    layouts: Vec<vk::PipelineLayout>,
    pipelines: Vec<vk::Pipeline>,
}

impl Kernels {
    /// Compiles all kernels.
    pub(super) fn new(raw: &ash::Device) -> Result<Self, DeviceError> {
        let n = KERNELS.len();
        let mut kernels = Self {
            set_layouts: Vec::with_capacity(n),
            layouts: Vec::with_capacity(n),
            pipelines: Vec::with_capacity(n),
        };
        for (spec, &spirv) in KERNELS.iter().zip(KERNEL_SPIRV) {
            if let Err(code) = kernels.compile(raw, spec, spirv) {
                kernels.destroy(raw);
                return Err(DeviceError::Kernel { kernel: spec.name, reason: code.to_string() });
            }
        }
        Ok(kernels)
    }

    fn compile(&mut self, raw: &ash::Device, spec: &KernelSpec, spirv: &[u32]) -> Result<(), vk::Result> {
        // Binding 0 is the uniform block; the storage buffers follow.
        let uniform = std::iter::once(vk::DescriptorType::UNIFORM_BUFFER);
        let types = uniform.chain(spec.bindings.iter().map(|_| vk::DescriptorType::STORAGE_BUFFER));
        let bindings: Vec<_> = (0..)
            .zip(types)
            .map(|(binding, kind)| {
                vk::DescriptorSetLayoutBinding::default()
                    .binding(binding)
                    .descriptor_type(kind)
                    .descriptor_count(1)
                    .stage_flags(vk::ShaderStageFlags::COMPUTE)
            })
            .collect();
        let set_info = vk::DescriptorSetLayoutCreateInfo::default().bindings(&bindings);
        let module_info = vk::ShaderModuleCreateInfo::default().code(spirv);
        // SAFETY: the device is alive; the SPIR-V is what naga validated and made when this program was built; every
        // object is kept in `self` as soon as it exists, and the module is only needed until its pipeline does.
        unsafe {
            let set_layout = raw.create_descriptor_set_layout(&set_info, None)?;
            self.set_layouts.push(set_layout);
            let layout_info = vk::PipelineLayoutCreateInfo::default().set_layouts(std::slice::from_ref(&set_layout));
            let layout = raw.create_pipeline_layout(&layout_info, None)?;
            self.layouts.push(layout);
            let module = raw.create_shader_module(&module_info, None)?;
            let stage = vk::PipelineShaderStageCreateInfo::default()
                .stage(vk::ShaderStageFlags::COMPUTE)
                .module(module)
                .name(c"main");
            let info = vk::ComputePipelineCreateInfo::default().stage(stage).layout(layout);
            let made = raw.create_compute_pipelines(vk::PipelineCache::null(), &[info], None);
            raw.destroy_shader_module(module, None);
            self.pipelines.push(made.map_err(|(_, code)| code)?[0]);
        }
        Ok(())
    }

    pub(super) fn pipeline(&self, kernel: usize) -> vk::Pipeline {
        self.pipelines[kernel]
    }

    pub(super) fn layout(&self, kernel: usize) -> vk::PipelineLayout {
        self.layouts[kernel]
    }

    pub(super) fn set_layout(&self, kernel: usize) -> vk::DescriptorSetLayout {
        self.set_layouts[kernel]
    }

    /// Ends everything; the device must be idle.
    pub(super) fn destroy(&mut self, raw: &ash::Device) {
        // SAFETY: the objects were made of this device, nobody uses them any more, and draining forgets them.
        unsafe {
            self.pipelines.drain(..).for_each(|pipeline| raw.destroy_pipeline(pipeline, None));
            self.layouts.drain(..).for_each(|layout| raw.destroy_pipeline_layout(layout, None));
            self.set_layouts.drain(..).for_each(|layout| raw.destroy_descriptor_set_layout(layout, None));
        }
    }
}
