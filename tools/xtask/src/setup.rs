//! Installs what the tests need beside Rust: a software Vulkan device.

use crate::step;
use std::path::Path;

const PACKAGES: [&str; 2] = ["mesa-vulkan-drivers", "libvulkan1"];

/// Whether a Vulkan device can be had, after trying to install one.
///
/// Without one the checks go on: what needs a device says that it was left out.
pub(crate) fn vulkan(root: &Path) -> bool {
    if is_installed() {
        return true;
    }
    let command = format!("apt-get update && apt-get install -y --no-install-recommends {}", PACKAGES.join(" "));
    let is_root = step::succeeds("sh", &["-c", "test \"$(id -u)\" = 0"]);
    if is_root && step::succeeds("apt-get", &["--version"]) {
        let environment = [("DEBIAN_FRONTEND", "noninteractive")];
        match step::run(root, "software Vulkan", "sh", &["-c", &command], &environment) {
            Ok(()) if is_installed() => return true,
            Ok(()) => {
                eprintln!("the packages are installed, but no Vulkan driver was found in /usr/share/vulkan/icd.d")
            }
            Err(failed) => eprintln!("{failed}"),
        }
    }
    eprintln!("no Vulkan device: tests that need one are left out. To have them, run:\n  sudo sh -c '{command}'");
    false
}

/// A loader and at least one driver.
fn is_installed() -> bool {
    let has_driver = ["/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d"]
        .iter()
        .any(|folder| std::fs::read_dir(folder).is_ok_and(|mut files| files.next().is_some()));
    has_driver && step::succeeds("sh", &["-c", "PATH=$PATH:/sbin:/usr/sbin ldconfig -p | grep -q libvulkan.so.1"])
}
