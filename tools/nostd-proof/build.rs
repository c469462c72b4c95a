//! Links the proof without libc and without its start files.

/// The profile that aborts on panic; any other build of this package is an ordinary program.
const PROFILE: &str = "nostd";

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    // Build scripts are not told the profile's name or its panic strategy; the output folder carries the name.
    let out_dir = std::env::var_os("OUT_DIR").map(std::path::PathBuf::from).unwrap_or_default();
    if out_dir.components().any(|part| part.as_os_str() == PROFILE) {
        for argument in ["-nostartfiles", "-nostdlib", "-static", "-no-pie"] {
            println!("cargo:rustc-link-arg-bins={argument}");
        }
    }
}
