//! Compiles every kernel of the kernel table from WGSL to SPIR-V, so that a kernel that does not compile is a build error
//! and the binary carries what a Vulkan device runs.

#[allow(dead_code, reason = "the map uses the rest")]
#[path = "../core/src/map/numbers.rs"]
mod numbers;
#[allow(dead_code, reason = "the library uses the rest")]
#[path = "src/splat/kernel_constants.rs"]
mod kernel_constants;
#[allow(dead_code, reason = "the library uses the rest")]
#[path = "src/splat/kernels.rs"]
mod kernels;

use kernels::{KERNELS, KernelSpec};
use naga::back::spv;
use naga::valid::{Capabilities, ShaderStages, SubgroupOperationSet, ValidationFlags, Validator};
use std::fmt::Write as _;
use std::path::Path;
use std::process::ExitCode;

fn main() -> ExitCode {
    for path in [
        "../shaders",
        "../core/src/map/numbers.rs",
        "src/splat/kernels.rs",
        "src/splat/kernel_constants.rs",
        "build.rs",
    ] {
        println!("cargo::rerun-if-changed={path}");
    }
    let mut text =
        String::from("/// SPIR-V of every row of the kernel table.\npub const KERNEL_SPIRV: &[&[u32]] = &[\n");
    let use_subgroups = KERNELS.iter().any(|spec| spec.wgsl().contains("subgroup"));
    let mut is_fine = true;
    for spec in KERNELS {
        match compile(spec) {
            Ok(words) => {
                let _ = writeln!(text, "    &{words:?},");
            }
            Err(problem) => {
                is_fine = false;
                println!("cargo::error={problem}");
            }
        }
    }
    text.push_str("];\n/// Some kernel uses subgroup operations.\n");
    let _ = writeln!(text, "pub const KERNELS_USE_SUBGROUPS: bool = {use_subgroups};");
    let out = std::env::var_os("OUT_DIR").unwrap_or_default();
    if let Err(error) = std::fs::write(Path::new(&out).join("kernel_spirv.rs"), text) {
        println!("cargo::error=writing the compiled kernels: {error}");
        is_fine = false;
    }
    if is_fine { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

/// SPIR-V of one kernel.
///
/// # Errors
/// `file:line: reason`, in the file that the line is from.
fn compile(spec: &KernelSpec) -> Result<Vec<u32>, String> {
    let source = spec.wgsl();
    let module = naga::front::wgsl::parse_str(&source).map_err(|error| {
        let line = error.location(&source).map_or(0, |location| location.line_number);
        placed(spec, line, error.message(), &error.emit_to_string(&source))
    })?;
    let info = Validator::new(ValidationFlags::all(), Capabilities::SUBGROUP)
        .subgroup_stages(ShaderStages::COMPUTE)
        .subgroup_operations(SubgroupOperationSet::all())
        .validate(&module)
        .map_err(|error| {
            let line = error.location(&source).map_or(0, |location| location.line_number);
            placed(spec, line, &error.as_inner().to_string(), &error.emit_to_string(&source))
        })?;
    let options = spv::Options {
        // Vulkan 1.1, the first with subgroups.
        lang_version: (1, 3),
        flags: spv::WriterFlags::empty(),
        // The device is opened with robust buffer access, and the kernels' loops end.
        bounds_check_policies: naga::proc::BoundsCheckPolicies::default(),
        force_loop_bounding: false,
        // Every kernel writes its shared memory before it reads it.
        zero_initialize_workgroup_memory: spv::ZeroInitializeWorkgroupMemoryMode::None,
        ..spv::Options::default()
    };
    spv::write_vec(&module, &info, &options, None).map_err(|error| format!("shaders/{}.wgsl: {error}", spec.name))
}

/// A message with the file and line where the problem stands. What naga says in detail follows on the same line, because
/// cargo shows one line per error.
fn placed(spec: &KernelSpec, line: u32, message: &str, detail: &str) -> String {
    let mut first = 1;
    let mut place = format!("shaders/{}.wgsl", spec.name);
    for (file, text) in spec.pieces() {
        let n_lines = text.lines().count() as u32;
        if (first..first + n_lines).contains(&line) {
            place = format!("{file}:{}", line - first + 1);
            break;
        }
        first += n_lines;
    }
    let detail = detail.lines().map(str::trim).collect::<Vec<_>>().join(" | ");
    format!("{place}: kernel {}: {message} ({detail})", spec.name)
}
