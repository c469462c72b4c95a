//! The kernels as `runtime/build.rs` compiled them.

include!(concat!(env!("OUT_DIR"), "/kernel_spirv.rs"));
