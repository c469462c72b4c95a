//! Which instruction set the kernels run on: found at run time, or asked for.

use core::fmt;
use pulp::{Arch, Scalar, WithSimd};

/// A level of SIMD; results are byte-identical between runs on the same level.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SimdLevel {
    /// x86-64 with AVX-512: 16 lanes.
    Avx512,
    /// x86-64 with AVX2 and FMA: 8 lanes.
    Avx2,
    /// 64-bit ARM: 4 lanes.
    Neon,
    /// Any machine: one lane.
    Baseline,
}

impl SimdLevel {
    /// All levels, best first.
    pub const ALL: [Self; 4] = [Self::Avx512, Self::Avx2, Self::Neon, Self::Baseline];

    /// The best level of this machine.
    pub fn best() -> Self {
        Self::ALL.into_iter().find(|level| level.arch().is_some()).unwrap_or(Self::Baseline)
    }

    /// Whether this machine has it.
    pub fn is_available(self) -> bool {
        self.arch().is_some()
    }

    /// Name on the command line and in reports.
    pub fn name(self) -> &'static str {
        match self {
            Self::Avx512 => "avx512",
            Self::Avx2 => "avx2",
            Self::Neon => "neon",
            Self::Baseline => "baseline",
        }
    }

    /// What runs code on this level, `None` when the machine lacks it.
    fn arch(self) -> Option<Arch> {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => pulp::x86::V4::try_new().map(Arch::V4),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => pulp::x86::V3::try_new().map(Arch::V3),
            #[cfg(target_arch = "aarch64")]
            Self::Neon => pulp::aarch64::Neon::try_new().map(Arch::Neon),
            Self::Baseline => Some(Arch::Scalar),
            #[allow(unreachable_patterns)]
            _ => None,
        }
    }
}

impl fmt::Display for SimdLevel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Runs kernels on one level.
#[derive(Clone, Copy, Debug)]
pub struct Dispatch {
    arch: Arch,
    /// The level.
    pub level: SimdLevel,
}

impl Dispatch {
    /// `None` when the machine lacks the level.
    pub fn new(level: SimdLevel) -> Option<Self> {
        level.arch().map(|arch| Self { arch, level })
    }

    /// Runs one kernel.
    #[inline(always)]
    pub fn run<Op: WithSimd>(self, kernel: Op) -> Op::Output {
        match self.arch {
            Arch::Scalar => pulp::Simd::vectorize(Scalar::new(), kernel),
            other => other.dispatch(kernel),
        }
    }
}
