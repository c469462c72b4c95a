//! The kernel table: every kernel of the device backends, with its WGSL text, its bindings and its workgroup size.
//!
//! `runtime/build.rs` compiles this table to SPIR-V and the wgpu executor hands the same text to its device, so this
//! file depends on nothing but its constants. Binding 0 of every kernel is the uniform block `view`; the table
//! lists what follows.

use super::kernel_constants::{self as constants, BLEND_GROUP, GROUP};

/// How a kernel touches a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    ReadWrite,
}

/// A storage buffer of a kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    /// Name of the WGSL variable.
    pub name: &'static str,
    /// How it is touched.
    pub access: Access,
}

/// One row of the kernel table.
#[derive(Clone, Copy, Debug)]
pub struct KernelSpec {
    /// File name without `.wgsl`; the entry point is `main`.
    pub name: &'static str,
    /// Storage buffers in the order of their binding numbers, from 1 on.
    pub bindings: &'static [Binding],
    /// Invocations of a workgroup, one-dimensional.
    pub workgroup_size: u32,
    shared: &'static [&'static str],
    body: &'static str,
}

const fn read(name: &'static str) -> Binding {
    Binding { name, access: Access::Read }
}

const fn write(name: &'static str) -> Binding {
    Binding { name, access: Access::ReadWrite }
}

/// Declares the kernels: the enum, and the table in the same order.
macro_rules! kernels {
    ($($(#[$doc:meta])* $kernel:ident = $name:literal, $size:expr, [$($shared:literal),*], [$($access:ident $binding:ident),*];)+) => {
        /// A kernel; its number is its row of [`KERNELS`].
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Kernel {
            $($(#[$doc])* $kernel,)+
        }

        /// The kernel table.
        pub const KERNELS: &[KernelSpec] = &[
            $(KernelSpec {
                name: $name,
                bindings: &[$($access(stringify!($binding))),*],
                workgroup_size: $size,
                shared: &[$(include_str!(concat!("../../../shaders/shared/", $shared, ".wgsl"))),*],
                body: include_str!(concat!("../../../shaders/", $name, ".wgsl")),
            },)+
        ];
    };
}

kernels! {
    /// Which Gaussians of each slot may be in view.
    Cull = "cull", GROUP, ["anchor", "lod", "scan"],
        [read anchors, read params, read keyframes, write visible_bits, write group_totals];
    /// Where each workgroup's candidates begin, and how many there are.
    ScanCandidates = "scan_candidates", GROUP, ["scan"], [write group_totals, write counters, write dispatch];
}

impl Kernel {
    /// Row of the kernel table.
    pub fn spec(self) -> &'static KernelSpec {
        &KERNELS[self as usize]
    }
}

impl KernelSpec {
    /// The kernel's whole WGSL text: constants, the uniform block, its shared snippets, its file.
    pub fn wgsl(&self) -> String {
        let mut text = constants::wgsl();
        text.push_str(include_str!("../../../shaders/shared/view.wgsl"));
        self.shared.iter().for_each(|snippet| text.push_str(snippet));
        text.push_str(self.body);
        text
    }
}

const _: () = assert!(BLEND_GROUP <= 256 && GROUP <= 256, "devices promise no more than 256 invocations");
