//! What computes the map: chosen before the plan is made, opened when the plan fits.
//!
//! A device that is asked for by name has to work; a device that `auto` finds may fail, and then the CPU computes.

use crate::budget::{ComputeMemory, row_behind_buffer};
use crate::run_error::RunError;
use crate::seal;
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::device::{CanFail, DeviceBackend, DeviceError, Executor, FallbackBackend, MakeSubstitute};
use crate::splat::vulkan::{DeviceKind, DeviceRequest, VulkanDevice, VulkanExecutor};
use crate::splat::wgpu::WgpuExecutor;
use crate::splat::{Capacities, SplatBackend};
use crate::telemetry;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// What computes the map, as asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum BackendChoice {
    /// The best one that is there.
    Auto,
    /// This processor.
    Cpu,
    /// A Vulkan device.
    Vulkan,
    /// A device through wgpu.
    Wgpu,
}

/// What computes the map. Clones are the same one.
#[derive(Debug, Clone)]
pub struct Compute {
    api: Api,
    /// It was asked for by name: the CPU is no answer.
    is_explicit: bool,
    state: Arc<State>,
}

#[derive(Debug, Clone)]
enum Api {
    Cpu,
    Vulkan(Arc<VulkanDevice>),
    Wgpu { name: String, has_own_memory: bool },
}

#[derive(Debug, Default)]
struct State {
    has_fallen_back: Arc<AtomicBool>,
    arena_bytes: AtomicU64,
}

/// What a backend is made of.
#[derive(Debug, Clone, Copy)]
pub struct BackendPlan {
    /// Its sizes.
    pub capacities: Capacities,
    /// What the budget grants a device's arena.
    pub arena_cap_bytes: u64,
    /// The budget has room for the CPU backend when a device is lost.
    pub has_substitute: bool,
    /// Threads of the CPU backend.
    pub n_threads: usize,
    /// Instruction set of the CPU backend.
    pub simd: SimdLevel,
}

impl Compute {
    /// Chooses, and opens a Vulkan device.
    ///
    /// # Errors
    /// [`RunError::Device`] when a device was asked for that cannot be had, [`RunError::Usage`] for a number without a
    /// choice of devices.
    pub fn choose(choice: BackendChoice, number: Option<u32>) -> Result<Self, RunError> {
        let request = number.map(DeviceRequest::Number);
        let device = |e: DeviceError| RunError::Device(e.to_string());
        let explicit = |api| Self { api, is_explicit: true, state: Arc::default() };
        match (choice, request) {
            (BackendChoice::Cpu | BackendChoice::Wgpu, Some(_)) => Err(RunError::Usage(
                "choosing the compute device: --device chooses among Vulkan devices; leave it out, or use --backend vulkan"
                    .to_owned(),
            )),
            (BackendChoice::Cpu, None) => Ok(explicit(Api::Cpu)),
            (BackendChoice::Auto | BackendChoice::Vulkan, Some(request)) => {
                let opened = VulkanDevice::open(request).map(Arc::new).map_err(device)?;
                if choice == BackendChoice::Auto && opened.info().kind == DeviceKind::Software {
                    return Err(RunError::Device(format!(
                        "choosing the compute device: {} is software, which --backend auto never takes; leave --device out, \
                         or give --backend vulkan as well",
                        opened.info().name
                    )));
                }
                Ok(explicit(Api::Vulkan(opened)))
            }
            (BackendChoice::Vulkan, None) => {
                Ok(explicit(Api::Vulkan(VulkanDevice::open(DeviceRequest::Any).map(Arc::new).map_err(device)?)))
            }
            (BackendChoice::Wgpu, None) => {
                let (name, has_own_memory) = WgpuExecutor::describe().map_err(device)?;
                Ok(explicit(Api::Wgpu { name, has_own_memory }))
            }
            (BackendChoice::Auto, None) => Ok(Self { api: best(), is_explicit: false, state: Arc::default() }),
        }
    }

    /// In whose memory it computes.
    pub fn memory(&self) -> ComputeMemory {
        let has_own = match &self.api {
            Api::Cpu => return ComputeMemory::Cpu,
            Api::Vulkan(device) => device.info().has_own_memory,
            Api::Wgpu { has_own_memory, .. } => *has_own_memory,
        };
        if has_own { ComputeMemory::OwnDevice } else { ComputeMemory::SharedDevice }
    }

    /// `cpu`, `vulkan` or `wgpu`: what computes now.
    pub fn kind(&self) -> &'static str {
        match &self.api {
            Api::Vulkan(_) if self.has_device() => "vulkan",
            Api::Wgpu { .. } if self.has_device() => "wgpu",
            _ => "cpu",
        }
    }

    /// What it calls itself, and what it was before a device was lost.
    pub fn name(&self) -> Option<String> {
        let device = match &self.api {
            Api::Cpu => return telemetry::processor_name(),
            Api::Vulkan(device) => &device.info().name,
            Api::Wgpu { name, .. } => name,
        };
        if self.has_device() {
            return Some(device.clone());
        }
        let processor = telemetry::processor_name().unwrap_or_else(|| "processor".to_owned());
        Some(format!("{processor} (instead of {device}, which failed)"))
    }

    /// Bytes of the device's arena; 0 without a device, and after it was lost.
    pub fn arena_bytes(&self) -> u64 {
        if self.has_device() { self.state.arena_bytes.load(Relaxed) } else { 0 }
    }

    /// The most that the arena of a device with its own memory ever was.
    pub fn device_peak_bytes(&self) -> u64 {
        if self.memory() == ComputeMemory::OwnDevice { self.state.arena_bytes.load(Relaxed) } else { 0 }
    }

    fn has_device(&self) -> bool {
        !matches!(self.api, Api::Cpu) && !self.state.has_fallen_back.load(Relaxed)
    }

    /// A backend of the plan's size.
    ///
    /// # Errors
    /// [`RunError::Usage`] names the row of the budget that the device cannot hold, [`RunError::Device`] says what else is
    /// wrong with a device that was asked for.
    pub fn open(&self, plan: &BackendPlan) -> Result<Box<dyn SplatBackend>, RunError> {
        let opened = match &self.api {
            _ if !self.has_device() => return cpu_backend(plan).map_err(RunError::Device),
            Api::Cpu => return cpu_backend(plan).map_err(RunError::Device),
            Api::Vulkan(device) => VulkanExecutor::new(device, &plan.capacities, plan.arena_cap_bytes)
                .and_then(|executor| self.with_fallback(plan, executor)),
            Api::Wgpu { .. } => WgpuExecutor::open(&plan.capacities, plan.arena_cap_bytes as usize)
                .and_then(|executor| self.with_fallback(plan, executor)),
        };
        match opened {
            Ok(backend) => Ok(backend),
            Err(error) if self.is_explicit => Err(run_error(&error, &plan.capacities)),
            Err(error) if !plan.has_substitute => Err(match run_error(&error, &plan.capacities) {
                RunError::Device(text) => RunError::Device(format!("{text}. The CPU cannot compute: {NO_SUBSTITUTE}")),
                of_a_row => of_a_row,
            }),
            Err(error) => {
                log::warn!("{error}. The CPU computes");
                self.state.has_fallen_back.store(true, Relaxed);
                cpu_backend(plan).map_err(RunError::Device)
            }
        }
    }

    fn with_fallback<E: Executor + 'static>(
        &self,
        plan: &BackendPlan,
        executor: E,
    ) -> Result<Box<dyn SplatBackend>, DeviceError>
    where
        DeviceBackend<E>: CanFail,
    {
        let arena_bytes = executor.device_bytes() as u64;
        log::info!(
            "{} computes the map: an arena of {:.1} MiB, {:.1} MiB planned",
            executor.device_name(),
            mib(arena_bytes),
            mib(plan.arena_cap_bytes)
        );
        self.state.arena_bytes.fetch_max(arena_bytes, Relaxed);
        let backend = DeviceBackend::new(plan.capacities, executor)?;
        let plan = *plan;
        let substitute: MakeSubstitute =
            Box::new(move || if plan.has_substitute { cpu_backend(&plan) } else { Err(NO_SUBSTITUTE.to_owned()) });
        Ok(Box::new(FallbackBackend::new(backend, substitute, Arc::clone(&self.state.has_fallen_back))))
    }
}

/// Why the CPU backend does not take over.
const NO_SUBSTITUTE: &str = "the budget keeps no room for it: write where = \"both\" for [map.anchors]";

/// A row that is too large is the budget's fault, everything else the device's.
fn run_error(error: &DeviceError, capacities: &Capacities) -> RunError {
    let too_large = match error {
        DeviceError::ArenaFull(full) => full.row,
        DeviceError::BufferTooLarge { name, .. } | DeviceError::TooManyGroups { name, .. } => name,
        _ => return RunError::Device(error.to_string()),
    };
    RunError::Usage(format!("[{}] is too large: {error}", row_behind_buffer(too_large, capacities)))
}

fn cpu_backend(plan: &BackendPlan) -> Result<Box<dyn SplatBackend>, String> {
    let opened = CpuBackend::new(plan.capacities, plan.n_threads, plan.simd, |_| {
        // The pool's workers live as long as the backend: sealed from their first breath.
        std::mem::forget(seal::enter());
    });
    opened.map(|backend| Box::new(backend) as Box<dyn SplatBackend>).map_err(|e| e.to_string())
}

/// A hardware device when there is one, else the CPU.
fn best() -> Api {
    // Asking a software driver what it is costs tens of megabytes: ask only where the kernel knows a graphics device.
    if !has_graphics_node() {
        return Api::Cpu;
    }
    match VulkanDevice::open(DeviceRequest::Hardware) {
        Ok(device) => Api::Vulkan(Arc::new(device)),
        Err(error) => {
            log::info!("the CPU computes the map ({error})");
            Api::Cpu
        }
    }
}

/// The kernel has a driver for some graphics device.
fn has_graphics_node() -> bool {
    let is_render_node = |entry: std::fs::DirEntry| entry.file_name().to_string_lossy().starts_with("renderD");
    let has_render_node = std::fs::read_dir("/dev/dri").is_ok_and(|nodes| nodes.flatten().any(is_render_node));
    has_render_node || ["/dev/nvidia0", "/dev/dxg", "/dev/mali0"].iter().any(|node| Path::new(node).exists())
}

fn mib(bytes: u64) -> f64 {
    bytes as f64 / f64::from(1 << 20)
}

/// Whether `auto` would use a device of this kind.
pub fn is_chosen_by_auto(kind: DeviceKind) -> bool {
    kind != DeviceKind::Software && has_graphics_node()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_needs_devices_to_choose_from() {
        for choice in [BackendChoice::Cpu, BackendChoice::Wgpu] {
            assert!(matches!(Compute::choose(choice, Some(0)), Err(RunError::Usage(_))), "{choice:?}");
        }
        let missing = Compute::choose(BackendChoice::Vulkan, Some(999)).map_err(|e| e.code());
        assert_eq!(missing.err(), Some(4));
    }

    #[test]
    fn a_device_that_auto_found_is_replaced_only_where_the_budget_pays_for_it() {
        let device = match VulkanDevice::open(DeviceRequest::Any) {
            Ok(device) => Arc::new(device),
            Err(error) => {
                println!("left out: no Vulkan device ({error})");
                return;
            }
        };
        for (is_explicit, has_substitute, expected) in
            [(false, true, Ok("cpu")), (false, false, Err(2)), (true, true, Err(2)), (true, false, Err(2))]
        {
            let compute = Compute { api: Api::Vulkan(Arc::clone(&device)), is_explicit, state: Arc::default() };
            let plan = BackendPlan {
                capacities: Capacities::for_map(64, 2, 32, 16),
                arena_cap_bytes: 1,
                has_substitute,
                n_threads: 1,
                simd: SimdLevel::best(),
            };
            let opened = compute.open(&plan).map(|_| compute.kind()).map_err(|error| error.code());
            assert_eq!(opened, expected, "asked for: {is_explicit}, room for the CPU: {has_substitute}");
        }
    }

    #[test]
    fn the_cpu_computes_in_host_memory_and_has_no_arena() {
        let cpu = Compute::choose(BackendChoice::Cpu, None).expect("always there");
        assert_eq!((cpu.kind(), cpu.memory()), ("cpu", ComputeMemory::Cpu));
        assert_eq!((cpu.arena_bytes(), cpu.device_peak_bytes()), (0, 0));
    }
}
