//! The checks themselves; each looks at one thing of the machine.

use super::Finding;
use crate::budget::{HumanBytes, Plan};
use crate::compute;
use crate::inference::{Manifest, ModelRow};
use crate::settings::Settings;
use crate::splat::cpu::SimdLevel;
use crate::splat::vulkan::{DeviceInfo, list_devices};

/// Where the frames of the capture process lie.
const SHARED_MEMORY: &str = "/dev/shm";

pub(super) fn cores() -> Finding {
    let subject = "cores";
    match std::thread::available_parallelism() {
        Ok(cores) if cores.get() == 1 => {
            Finding::fine(subject, "1: tracking and mapping share it, mapping gets what is left".to_owned())
        }
        Ok(cores) => Finding::fine(subject, cores.to_string()),
        Err(error) => Finding::fine(subject, format!("unknown ({error}): one is assumed")),
    }
}

pub(super) fn simd() -> Finding {
    let best = SimdLevel::best();
    let note = if best == SimdLevel::Baseline { ": mapping runs without SIMD, several times slower" } else { "" };
    Finding::fine("SIMD", format!("{}{note}", best.name()))
}

pub(super) fn shared_memory(ipc_bytes: u64) -> Finding {
    let subject = "shared memory";
    let statistics = match rustix::fs::statvfs(SHARED_MEMORY) {
        Ok(statistics) => statistics,
        Err(error) => {
            let advice = format!("mount a tmpfs there: mount -t tmpfs tmpfs {SHARED_MEMORY}");
            return Finding::mend(subject, format!("{SHARED_MEMORY} cannot be used ({error})"), advice);
        }
    };
    let free = statistics.f_bavail.saturating_mul(statistics.f_frsize);
    let found = format!("{} free in {SHARED_MEMORY}, the frames need {}", HumanBytes(free), HumanBytes(ipc_bytes));
    if free >= ipc_bytes {
        return Finding::fine(subject, found);
    }
    let needed_mib = ipc_bytes.div_ceil(1 << 20);
    let advice = format!(
        "remove what is left there, or enlarge it: mount -o remount,size={needed_mib}m {SHARED_MEMORY} \
         (in a container: --shm-size={needed_mib}m)"
    );
    Finding::mend(subject, found, advice)
}

pub(super) fn budget(plan: &Plan, file: &str) -> Finding {
    match plan.check() {
        Ok(()) => Finding::fine("budget", format!("{file}: the plan takes {}", HumanBytes(plan.host_bytes()))),
        Err(error) => Finding::mend("budget", "the plan is above its cap".to_owned(), error.to_string()),
    }
}

pub(super) fn machine_memory(planned_bytes: u64) -> Finding {
    let subject = "memory";
    let Some(available) = available_bytes() else {
        return Finding::fine(subject, "unknown: there is no /proc/meminfo".to_owned());
    };
    let found = format!("{} available, the plan takes {}", HumanBytes(available), HumanBytes(planned_bytes));
    if available >= planned_bytes {
        return Finding::fine(subject, found);
    }
    Finding::mend(subject, found, "close other programs, or choose a smaller budget with --budget FILE".to_owned())
}

/// What the kernel can give, or less where a control group allows less.
fn available_bytes() -> Option<u64> {
    let of_machine = meminfo_available(&std::fs::read_to_string("/proc/meminfo").ok()?)?;
    let read_number = |file: &str| std::fs::read_to_string(file).ok()?.trim().parse::<u64>().ok();
    let limit = read_number("/sys/fs/cgroup/memory.max");
    let used = read_number("/sys/fs/cgroup/memory.current").unwrap_or(0);
    let of_group = limit.map_or(u64::MAX, |limit| limit.saturating_sub(used));
    Some(of_machine.min(of_group))
}

fn meminfo_available(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix("kB")?.trim_end().parse::<u64>().ok()?.checked_mul(1024)
}

/// A line per device, and whether `--backend auto` takes it.
pub(super) fn vulkan() -> Vec<Finding> {
    let subject = "Vulkan";
    let devices = match list_devices() {
        Ok(devices) if !devices.is_empty() => devices,
        Ok(_) => return vec![Finding::fine(subject, "no device: the CPU computes the map".to_owned())],
        Err(error) => return vec![Finding::fine(subject, format!("not used, the CPU computes the map ({error})"))],
    };
    let found = |device: &DeviceInfo| {
        let by_auto = compute::is_chosen_by_auto(device.kind) && device.missing.is_none();
        let number = device.number;
        let how = if by_auto { "used".to_owned() } else { format!("only with --backend vulkan --device {number}") };
        Finding::fine(subject, format!("{device}: {how}"))
    };
    devices.iter().map(found).collect()
}

/// A line per network: its file is there and what the manifest says. What is not shipped has to be mended only where the
/// settings want it.
pub(super) fn models(settings: &Settings) -> Vec<Finding> {
    let subject = "models";
    let needed = settings.tracking.matcher.roles();
    let manifest = match Manifest::find(&settings.inference.models) {
        Ok(manifest) => manifest,
        Err(error) if needed.is_empty() => return vec![Finding::fine(subject, format!("none, none needed ({error})"))],
        Err(error) => return vec![Finding::mend(subject, "none found".to_owned(), error.to_string())],
    };
    let found = |row: &ModelRow| match manifest.check(row) {
        Ok(()) => Finding::fine(subject, format!("{} ({}, {})", row.name, row.role, row.licence)),
        Err(error) if needed.contains(&row.role) => Finding::mend(subject, row.name.clone(), error.to_string()),
        Err(error) => Finding::fine(subject, format!("{} is not used and cannot be: {error}", row.name)),
    };
    manifest.rows().iter().map(found).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_little_memory_is_to_be_mended() {
        let check = |finding: Finding, is_fine: bool| assert_eq!(finding.advice.is_none(), is_fine, "{finding}");
        check(machine_memory(1), true);
        check(machine_memory(u64::MAX), false);
        check(shared_memory(1), true);
        check(shared_memory(u64::MAX), false);
        assert!(shared_memory(1 << 60).to_string().contains("--shm-size=1099511627776m"));
    }

    #[test]
    fn available_memory_is_read() {
        assert_eq!(meminfo_available("MemTotal: 9 kB\nMemAvailable:    1024 kB\n"), Some(1 << 20));
        assert_eq!(meminfo_available("MemTotal: 9 kB\n"), None);
    }
}
