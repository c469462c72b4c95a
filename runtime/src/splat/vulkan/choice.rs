//! Which of the machine's devices is used.

use crate::splat::device::DeviceError;
use std::fmt;

/// What a device is made of, best first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum DeviceKind {
    /// A card with memory of its own.
    Discrete,
    /// Part of the processor's chip.
    Integrated,
    /// A slice of a device of the machine below.
    Virtual,
    /// Something else with a driver of its own.
    Other,
    /// A program on the CPU, such as lavapipe.
    Software,
}

impl DeviceKind {
    /// For people.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Discrete => "discrete",
            Self::Integrated => "integrated",
            Self::Virtual => "virtual",
            Self::Other => "other",
            Self::Software => "software",
        }
    }
}

/// What is known of a device before it is opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeviceInfo {
    /// Its number for `--device`, in the loader's order.
    pub number: u32,
    /// As the driver calls it.
    pub name: String,
    /// What it is made of.
    pub kind: DeviceKind,
    /// Driver and its version.
    pub driver: String,
    /// Version of Vulkan, major and minor.
    pub api: (u32, u32),
    /// Lanes of a subgroup; kernels work with 4 to 64.
    pub subgroup_size: u32,
    /// Largest heap of device memory, bytes.
    pub heap_bytes: u64,
    /// That heap is not the machine's memory.
    pub has_own_memory: bool,
    /// Largest buffer that a kernel can see, bytes.
    pub max_storage_bytes: u64,
    /// Why it cannot be used, if so.
    pub missing: Option<&'static str>,
}

impl fmt::Display for DeviceInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (major, minor) = self.api;
        write!(
            f,
            "{}: {} ({}, {}, Vulkan {major}.{minor}, subgroups of {}, {} MiB)",
            self.number,
            self.name,
            self.kind.name(),
            self.driver,
            self.subgroup_size,
            self.heap_bytes >> 20
        )?;
        self.missing.map_or(Ok(()), |missing| write!(f, ", not usable: no {missing}"))
    }
}

/// Which device is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DeviceRequest {
    /// The best one that is faster than the CPU backend: never a software device.
    Hardware,
    /// The best one of any kind.
    Any,
    /// This one.
    Number(u32),
}

/// The device to open: the wanted one, else the best by kind; among equals the first.
///
/// # Errors
/// [`DeviceError::NoDevice`] says what was looked for and what it lacks.
pub fn choose(devices: &[DeviceInfo], request: DeviceRequest) -> Result<&DeviceInfo, DeviceError> {
    if let DeviceRequest::Number(number) = request {
        let wanted = devices.iter().find(|device| device.number == number);
        let device =
            wanted.ok_or_else(|| no_device(format!("there is no device {number}, but {} in all", devices.len())))?;
        return match device.missing {
            None => Ok(device),
            Some(missing) => Err(no_device(format!("{} has no {missing}", device.name))),
        };
    }
    let is_wanted = |device: &&DeviceInfo| {
        device.missing.is_none() && (request == DeviceRequest::Any || device.kind != DeviceKind::Software)
    };
    devices.iter().filter(is_wanted).min_by_key(|device| device.kind).ok_or_else(|| {
        no_device(match (devices.first(), request) {
            (None, _) => "no driver offers one (on Debian install mesa-vulkan-drivers)".to_owned(),
            (Some(first), DeviceRequest::Hardware) => format!("there is no hardware device, only {first}"),
            (Some(first), _) => format!("none of {} is usable, the first is {first}", devices.len()),
        })
    })
}

pub(super) fn no_device(reason: String) -> DeviceError {
    DeviceError::NoDevice { api: "Vulkan", reason }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn device(number: u32, kind: DeviceKind, missing: Option<&'static str>) -> DeviceInfo {
        DeviceInfo {
            number,
            name: format!("device {number}"),
            kind,
            driver: "driver 1".to_owned(),
            api: (1, 3),
            subgroup_size: 32,
            heap_bytes: 1 << 30,
            has_own_memory: true,
            max_storage_bytes: 1 << 27,
            missing,
        }
    }

    #[test]
    fn the_best_device_is_found_and_software_only_when_asked_for() {
        use DeviceKind::{Discrete, Integrated, Software};
        let check = |kinds: &[DeviceKind], request, expected: Option<u32>| {
            let devices: Vec<_> = (0..).zip(kinds).map(|(number, &kind)| device(number, kind, None)).collect();
            assert_eq!(choose(&devices, request).ok().map(|d| d.number), expected, "{kinds:?} {request:?}");
        };
        check(&[], DeviceRequest::Any, None);
        check(&[Software], DeviceRequest::Hardware, None);
        check(&[Software], DeviceRequest::Any, Some(0));
        check(&[Software], DeviceRequest::Number(0), Some(0));
        check(&[Software], DeviceRequest::Number(1), None);
        check(&[Software, Integrated, Discrete, Discrete], DeviceRequest::Hardware, Some(2));
        check(&[Software, Integrated, Discrete], DeviceRequest::Number(1), Some(1));
        check(&[Software, Integrated], DeviceRequest::Any, Some(1));
    }

    #[test]
    fn a_device_that_lacks_something_is_passed_over_or_refused() {
        let devices =
            [device(0, DeviceKind::Discrete, Some("timeline semaphores")), device(1, DeviceKind::Software, None)];
        assert_eq!(choose(&devices, DeviceRequest::Any).map(|d| d.number), Ok(1));
        assert!(matches!(choose(&devices, DeviceRequest::Hardware), Err(DeviceError::NoDevice { .. })));
        let refused = choose(&devices, DeviceRequest::Number(0)).map_err(|e| e.to_string());
        let expected = "opening a Vulkan device: device 0 has no timeline semaphores; `kilogs doctor` lists the devices, --backend cpu needs none";
        assert_eq!(refused.map(|d| d.number), Err(expected.to_owned()));
    }
}
