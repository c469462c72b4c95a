//! The devices to test on: whatever is there, and a word about what is not.

use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::device::{DeviceBackend, DeviceError, Executor};
use crate::splat::program::{Buffer, Part};
use crate::splat::vulkan::{VulkanBackend, VulkanExecutor, testing};
use crate::splat::wgpu::{WgpuBackend, WgpuExecutor};
use crate::splat::{BACKGROUND_TEXELS, Capacities, SplatBackend, StepReport, StepSettings, TrainingView, View};
use zerocopy::IntoBytes;

/// Memory that a test may take.
const CAP_BYTES: usize = 1 << 30;

/// A device backend, whatever its driver.
pub trait Device: SplatBackend {
    /// Gradients of the Gaussians' numbers and of the background.
    fn gradients(&mut self, view: &View, upstream: &[Vec<f32>; 5]) -> (Vec<[f32; N_PARAMS]>, Vec<[f32; 3]>);

    /// Loss of a training view and the same gradients; nothing is trained.
    fn training_gradients(&mut self, training: &TrainingView<'_>, settings: &StepSettings) -> TrainingGradients;

    /// Bytes of the device's memory.
    fn arena_bytes(&self) -> u64;

    /// Runs one stage again on what is there, and waits for it.
    fn run_stage(&mut self, view: &View, part: Part, idx: usize);

    /// First words of a buffer.
    fn words(&self, buffer: Buffer, n: usize) -> Vec<u32>;

    /// Overwrites the beginning of a buffer.
    fn set_words(&mut self, buffer: Buffer, words: &[u32]);
}

/// What a training view would teach.
pub struct TrainingGradients {
    pub report: StepReport,
    pub params: Vec<[f32; N_PARAMS]>,
    pub texels: Vec<[f32; 3]>,
}

impl<E: Executor> Device for DeviceBackend<E> {
    fn gradients(&mut self, view: &View, upstream: &[Vec<f32>; 5]) -> (Vec<[f32; N_PARAMS]>, Vec<[f32; 3]>) {
        let planes = [&upstream[0], &upstream[1], &upstream[2], &upstream[3], &upstream[4]].map(Vec::as_slice);
        let n = self.capacities().anchors * self.capacities().gaussians_per_anchor;
        let (mut params, mut texels) = (vec![[f32::NAN; N_PARAMS]; n], vec![[f32::NAN; 3]; BACKGROUND_TEXELS]);
        assert!(DeviceBackend::gradients(self, view, planes, &mut params, &mut texels), "{:?}", self.failure());
        (params, texels)
    }

    fn training_gradients(&mut self, training: &TrainingView<'_>, settings: &StepSettings) -> TrainingGradients {
        let parts = [Part::Compare, Part::Backward];
        let n = self.capacities().anchors * self.capacities().gaussians_per_anchor;
        let (mut params, mut texels) = (vec![[f32::NAN; N_PARAMS]; n], vec![[f32::NAN; 3]; BACKGROUND_TEXELS]);
        let (report, _) = self.compare(training, settings, 1, &parts).expect("fits");
        assert!(self.read_gradients(&mut params, &mut texels), "{:?}", self.failure());
        TrainingGradients { report, params, texels }
    }

    fn arena_bytes(&self) -> u64 {
        self.device_bytes() as u64
    }

    fn run_stage(&mut self, view: &View, part: Part, idx: usize) {
        let work = self.work(view);
        let ran = self.device.call(|e| {
            e.run_stage(part, idx, &work)?;
            e.download(Buffer::Counters, 0, &mut [0; 4])
        });
        assert!(ran, "{:?}", self.failure());
    }

    fn words(&self, buffer: Buffer, n: usize) -> Vec<u32> {
        let mut out = vec![0u32; n];
        assert!(self.device.call(|e| e.download(buffer, 0, out.as_mut_bytes())), "{:?}", self.failure());
        out
    }

    fn set_words(&mut self, buffer: Buffer, words: &[u32]) {
        assert!(self.device.call(|e| e.upload(buffer, 0, words.as_bytes())), "{:?}", self.failure());
    }
}

/// Calls `check` with a backend of every device API that is present; without a device says so, or fails when
/// `KILOGS_REQUIRE_VULKAN=1`.
pub fn on_every_device(capacities: Capacities, mut check: impl FnMut(&str, &mut dyn Device)) {
    on_vulkan(capacities, &mut check);
    on_wgpu(capacities, check);
}

/// The same with Vulkan alone.
pub fn on_vulkan(capacities: Capacities, check: impl FnOnce(&str, &mut dyn Device)) {
    if let Some(executor) = vulkan_executor(&capacities) {
        check("vulkan", &mut VulkanBackend::new(capacities, executor).unwrap_or_else(|e| panic!("{e}")));
    }
}

/// The same with wgpu alone.
pub fn on_wgpu(capacities: Capacities, check: impl FnOnce(&str, &mut dyn Device)) {
    if let Some(executor) = wgpu_executor(&capacities) {
        check("wgpu", &mut WgpuBackend::new(capacities, executor).unwrap_or_else(|e| panic!("{e}")));
    }
}

/// The same with an executor, for what lies below a backend.
pub fn on_every_executor(capacities: &Capacities, mut check: impl FnMut(&str, &mut dyn Executor)) {
    if let Some(mut executor) = vulkan_executor(capacities) {
        check("vulkan", &mut executor);
    }
    if let Some(mut executor) = wgpu_executor(capacities) {
        check("wgpu", &mut executor);
    }
}

fn vulkan_executor(capacities: &Capacities) -> Option<VulkanExecutor> {
    let device = testing::device()?;
    Some(VulkanExecutor::new(&device, capacities, CAP_BYTES as u64).unwrap_or_else(|e| panic!("{e}")))
}

/// A wgpu executor, where there is an adapter.
pub fn wgpu_executor(capacities: &Capacities) -> Option<WgpuExecutor> {
    match WgpuExecutor::open(capacities, CAP_BYTES) {
        Ok(executor) => Some(executor),
        Err(DeviceError::NoDevice { api, reason }) => {
            skip(api, &reason);
            None
        }
        Err(error) => panic!("{error}"),
    }
}

fn skip(api: &str, reason: &str) {
    println!("skipped: no {api} adapter ({reason})");
    let required = std::env::var_os("KILOGS_REQUIRE_VULKAN").is_some_and(|v| v == "1");
    assert!(!required, "KILOGS_REQUIRE_VULKAN=1 and no {api} adapter: {reason}");
}
