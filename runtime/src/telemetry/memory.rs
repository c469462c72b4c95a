//! Resident memory as the kernel sees it, once a second.

use super::slope::{Growth, RssSlope};
use std::fs::File;
use std::io::Read;
use std::time::{Duration, Instant};

const SAMPLE_PERIOD: Duration = Duration::from_secs(1);

/// Longer than any `/proc/<pid>/status`, so that reading it needs no heap.
const STATUS_BYTES: usize = 4096;

/// Resident size of a process.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ProcessMemory {
    /// Resident now (`VmRSS`).
    pub rss_bytes: u64,
    /// The most that was ever resident (`VmHWM`).
    pub peak_bytes: u64,
    /// Part of the resident size that is shared memory (`RssShmem`).
    pub shared_bytes: u64,
}

/// Resident size of process `pid`, or of this one; `None` when it has ended or there is no `/proc`.
pub fn process_memory(pid: Option<u32>) -> Option<ProcessMemory> {
    let mut file = match pid {
        Some(pid) => File::open(format!("/proc/{pid}/status")),
        None => File::open("/proc/self/status"),
    }
    .ok()?;
    let mut buffer = [0; STATUS_BYTES];
    let mut filled = 0;
    while let Ok(n) = file.read(buffer.get_mut(filled..)?) {
        if n == 0 {
            break;
        }
        filled += n;
    }
    parse_status(std::str::from_utf8(buffer.get(..filled)?).ok()?)
}

/// A zombie has no `Vm` lines: it has no memory any more.
fn parse_status(status: &str) -> Option<ProcessMemory> {
    let bytes_of = |key: &str| {
        let line = status.lines().find_map(|line| line.strip_prefix(key)?.strip_prefix(':'))?;
        let kib: u64 = line.trim().strip_suffix("kB")?.trim_end().parse().ok()?;
        kib.checked_mul(1024)
    };
    Some(ProcessMemory {
        rss_bytes: bytes_of("VmRSS")?,
        peak_bytes: bytes_of("VmHWM")?,
        shared_bytes: bytes_of("RssShmem").unwrap_or(0),
    })
}

/// Samples this process and the capture process once a second and remembers peaks and slope.
#[derive(Debug)]
pub struct MemoryWatch {
    camera_pid: Option<u32>,
    last_sample: Option<Instant>,
    own: ProcessMemory,
    camera: Option<ProcessMemory>,
    slope: RssSlope,
}

impl MemoryWatch {
    /// Watches this process, and the capture process when it is a child of ours.
    pub fn new(camera_pid: Option<u32>) -> Self {
        Self { camera_pid, last_sample: None, own: ProcessMemory::default(), camera: None, slope: RssSlope::default() }
    }

    /// Takes a sample when a second has passed since the last one; says whether it did.
    pub fn sample(&mut self, now: Instant, distance_m: f64) -> bool {
        if self.last_sample.is_some_and(|last| now.saturating_duration_since(last) < SAMPLE_PERIOD) {
            return false;
        }
        self.last_sample = Some(now);
        self.read();
        self.slope.push(distance_m, self.own.rss_bytes);
        true
    }

    /// Reads both processes now, whatever the time: before the capture process ends, and for the final report.
    pub fn read(&mut self) {
        if let Some(own) = process_memory(None) {
            self.own = own;
        }
        // The peak of a capture process that has ended stays.
        if let Some(camera) = self.camera_pid.and_then(|pid| process_memory(Some(pid))) {
            let peak_before = self.camera.map_or(0, |before| before.peak_bytes);
            self.camera = Some(ProcessMemory { peak_bytes: camera.peak_bytes.max(peak_before), ..camera });
        }
    }

    /// This process.
    pub fn own(&self) -> ProcessMemory {
        self.own
    }

    /// The capture process, if it is known and was seen alive.
    pub fn camera(&self) -> Option<ProcessMemory> {
        self.camera
    }

    /// Growth of this process over the distance driven; `None` below 600 m.
    pub fn growth(&self) -> Option<Growth> {
        self.slope.growth()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_status_text_is_read_and_a_broken_one_is_not() {
        const STATUS: &str = "Name:\tx\nVmHWM:\t    1768 kB\nVmRSS:\t     512 kB\nRssShmem:\t       4 kB\n";
        let expected = ProcessMemory { rss_bytes: 512 << 10, peak_bytes: 1768 << 10, shared_bytes: 4 << 10 };
        assert_eq!(parse_status(STATUS), Some(expected));
        assert_eq!(parse_status("Name:\tzombie\nState:\tZ\n"), None);
        assert_eq!(parse_status("VmHWM:\t1 kB\nVmRSS:\tmany kB\n"), None);
        assert_eq!(parse_status("VmHWM:\t1 kB\nVmRSS:\t99999999999999999999 kB\n"), None);
    }

    #[test]
    fn touched_memory_shows_in_this_process_and_a_child_is_seen() {
        const BLOCK: u64 = 64 << 20;
        let before = process_memory(None).expect("a /proc");
        let block = std::hint::black_box(vec![1_u8; BLOCK as usize]);
        let during = process_memory(None).expect("a /proc");
        assert!(during.rss_bytes >= before.rss_bytes + BLOCK / 2, "{before:?} {during:?}");
        drop(block);
        // The kernel adds up its counts per thread now and then: the two figures may be of different moments.
        const LAG: u64 = 4 << 20;
        assert!(process_memory(None).expect("a /proc").peak_bytes + LAG >= during.rss_bytes);

        let mut child = std::process::Command::new("sleep").arg("5").spawn().expect("sleep");
        let mut watch = MemoryWatch::new(Some(child.id()));
        watch.read();
        child.kill().and_then(|()| child.wait()).expect("the child ends");
        let seen = watch.camera().expect("the child was alive");
        assert!(seen.peak_bytes > 0);
        watch.read();
        assert_eq!(watch.camera(), Some(seen), "an ended child keeps its figures");
        assert_eq!(process_memory(Some(child.id())), None);
    }

    #[test]
    fn samples_come_once_a_second() {
        let mut watch = MemoryWatch::new(None);
        let start = Instant::now();
        let check = |watch: &mut MemoryWatch, ms: u64, taken: bool| {
            assert_eq!(watch.sample(start + Duration::from_millis(ms), 0.0), taken, "{ms} ms");
        };
        check(&mut watch, 0, true);
        check(&mut watch, 999, false);
        check(&mut watch, 1000, true);
        check(&mut watch, 1999, false);
        check(&mut watch, 2500, true);
        assert!(watch.own().rss_bytes > 0);
    }
}
