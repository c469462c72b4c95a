//! Options that every command which tracks and maps understands.

use crate::budget::Budget;
use crate::compute::{BackendChoice, Compute};
use crate::config::ConfigArgs;
use crate::run_error::RunError;
use crate::settings::Settings;
use crate::splat::cpu::SimdLevel;
use kilogs_core::conventions::{Rigid, rotation_from_xyzw};
use nalgebra::Translation3;
use std::path::PathBuf;

/// Options shared by `demo`, `replay` and `run`.
#[derive(Debug, Clone, clap::Args)]
pub struct CommonArgs {
    /// Settings file and single settings.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Memory budget file, or the name of a built-in profile.
    #[arg(long, value_name = "FILE")]
    pub budget: Option<PathBuf>,
    /// What computes the map. `auto` never picks a software Vulkan device.
    #[arg(long, value_enum, default_value_t = BackendChoice::Auto)]
    pub backend: BackendChoice,
    /// Number of the compute device, as `kilogs doctor` lists them.
    #[arg(long, value_name = "N")]
    pub device: Option<u32>,
    /// Instruction set of the CPU kernels.
    #[arg(long, value_enum, default_value_t = SimdChoice::Auto)]
    pub simd: SimdChoice,
    /// Threads of the mapper; all cores by default, all but one with a live camera.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub threads: Option<u16>,
    /// Seed of everything random.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub seed: u64,
}

/// Options that every command takes, so that a script can give all of them the same: what computes.
///
/// Of no use to a command that computes nothing, and hidden there.
#[derive(Debug, Clone, clap::Args)]
pub struct UnusedKernelArgs {
    #[arg(long, value_enum, hide = true)]
    simd: Option<SimdChoice>,
    #[arg(long, value_name = "N", hide = true, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    #[arg(long, value_name = "N", hide = true)]
    seed: Option<u64>,
}

/// The others of these options, but for the budget.
#[derive(Debug, Clone, clap::Args)]
pub struct UnusedArgs {
    #[arg(long, value_name = "FILE", hide = true)]
    config: Option<PathBuf>,
    #[arg(long = "set", value_name = "KEY=VALUE", hide = true)]
    set: Vec<String>,
    #[arg(long, value_enum, hide = true)]
    backend: Option<BackendChoice>,
    #[arg(long, value_name = "N", hide = true)]
    device: Option<u32>,
    #[command(flatten)]
    kernels: UnusedKernelArgs,
}

/// The map to go on with.
#[derive(Debug, Clone, clap::Args)]
pub struct ResumeArgs {
    /// Go on in this map, also one whose writing was interrupted: it grows in place, the other outputs go to --out.
    #[arg(long, value_name = "MAP")]
    pub resume: Option<PathBuf>,
    /// Where the camera is in that map at the first frame, `x,y,z,qx,qy,qz,qw` in metres; without, the drive begins where
    /// the map's last one ended.
    #[arg(long, value_name = "POSE", requires = "resume", value_parser = parse_pose, allow_hyphen_values = true)]
    pub resume_pose: Option<Rigid>,
}

/// A pose as seven numbers.
fn parse_pose(text: &str) -> Result<Rigid, String> {
    let numbers: Option<Vec<f64>> = text.split(',').map(|number| number.trim().parse().ok()).collect();
    let numbers = numbers.filter(|numbers| numbers.iter().all(|number| number.is_finite()));
    match numbers.as_deref() {
        Some(&[x, y, z, qx, qy, qz, qw]) if [qx, qy, qz, qw].iter().any(|number| number.abs() > 0.0) => {
            Ok(Rigid::from_parts(Translation3::new(x, y, z), rotation_from_xyzw([qx, qy, qz, qw])))
        }
        _ => Err("give seven numbers, x,y,z,qx,qy,qz,qw, of a quaternion that is not zero".to_owned()),
    }
}

/// Instruction set of the CPU kernels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum SimdChoice {
    /// The widest this processor has.
    Auto,
    /// AVX-512.
    Avx512,
    /// AVX2 with FMA.
    Avx2,
    /// NEON.
    Neon,
    /// What every processor of the architecture has.
    Baseline,
}

impl CommonArgs {
    /// Settings of all layers, checked.
    ///
    /// # Errors
    /// [`RunError::Config`].
    pub fn settings(&self) -> Result<Settings, RunError> {
        Ok(crate::config::load(&self.config)?)
    }

    /// The memory budget.
    ///
    /// # Errors
    /// [`RunError::Budget`].
    pub fn budget(&self) -> Result<Budget, RunError> {
        Ok(Budget::load(self.budget.as_deref())?)
    }

    /// What computes the map.
    ///
    /// # Errors
    /// [`RunError::Device`] when a device was asked for that cannot be had.
    pub fn compute(&self) -> Result<Compute, RunError> {
        Compute::choose(self.backend, self.device)
    }

    /// The instruction set to use.
    ///
    /// # Errors
    /// [`RunError::Device`] when this processor does not have it.
    pub fn simd(&self) -> Result<SimdLevel, RunError> {
        let level = match self.simd {
            SimdChoice::Auto => SimdLevel::best(),
            SimdChoice::Avx512 => SimdLevel::Avx512,
            SimdChoice::Avx2 => SimdLevel::Avx2,
            SimdChoice::Neon => SimdLevel::Neon,
            SimdChoice::Baseline => SimdLevel::Baseline,
        };
        if level.is_available() {
            return Ok(level);
        }
        Err(RunError::Device(format!(
            "choosing the instruction set: this processor has no {}; use --simd auto",
            level.name()
        )))
    }

    /// Threads of the mapper; a live camera leaves one core to tracking.
    pub fn n_threads(&self, is_live: bool) -> usize {
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let default = if is_live { cores.saturating_sub(1).max(1) } else { cores };
        self.threads.map_or(default, usize::from)
    }
}
