//! `report.json`: the figures of a run under names that do not change.
//!
//! An unknown figure is null, never absent, so every reader can rely on the keys; a test compares them with
//! the contract. Figures that a run may be unable to measure are `Option`s, counts are plain numbers.

use super::OutputError;
use crate::budget::{Plan, Usage};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Version of the format.
const VERSION: u32 = 1;

/// The whole report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// Version of the format.
    pub version: u32,
    /// The command line, as typed.
    pub command: String,
    /// Frames by what became of them.
    pub frames: Frames,
    /// Durations.
    pub time: Time,
    /// Memory: plan, peaks, violations.
    pub memory: Memory,
    /// What tracking did.
    pub tracking: Tracking,
    /// What the map is.
    pub mapping: Mapping,
    /// What computed it.
    pub backend: Backend,
}

impl Default for Report {
    fn default() -> Self {
        Self {
            version: VERSION,
            command: String::new(),
            frames: Frames::default(),
            time: Time::default(),
            memory: Memory::default(),
            tracking: Tracking::default(),
            mapping: Mapping::default(),
            backend: Backend::default(),
        }
    }
}

/// Frame counts; `received = tracked + doubtful + lost + dropped`, keyframes are tracked frames.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Frames {
    /// All frames that were accepted or are known to be missing.
    pub received: u64,
    /// With a verified pose.
    pub tracked: u64,
    /// Tracked frames that became keyframes.
    pub keyframes: u64,
    /// With a predicted pose.
    pub doubtful: u64,
    /// Without a pose.
    pub lost: u64,
    /// Never reached the tracker.
    pub dropped: u64,
    /// Messages that were no frame: bad header, wrong size, time going backwards.
    pub refused: u64,
}

impl From<super::FrameCounts> for Frames {
    fn from(counts: super::FrameCounts) -> Self {
        Self {
            received: counts.received(),
            tracked: counts.tracked,
            keyframes: counts.keyframes,
            doubtful: counts.doubtful,
            lost: counts.lost,
            dropped: counts.dropped,
            refused: 0,
        }
    }
}

/// Median, 95th percentile and maximum, ms.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Percentiles {
    /// Half of all are at most this.
    pub p50: Option<f64>,
    /// 95 % of all are at most this.
    pub p95: Option<f64>,
    /// The largest.
    pub max: Option<f64>,
}

/// Durations.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Time {
    /// Start to end of the run, s.
    pub wall_s: Option<f64>,
    /// One frame through the whole pipeline.
    pub per_frame_ms: Percentiles,
    /// One frame through the tracker.
    pub tracking_ms: Percentiles,
    /// Training steps of the map.
    pub mapping_iterations: u64,
    /// Training steps per second of mapping time.
    pub mapping_it_per_s: Option<f64>,
}

/// Memory.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Memory {
    /// Peak resident size of this process.
    pub rss_peak_bytes: Option<u64>,
    /// Peak resident size of the capture process; unknown when it is not our child.
    pub camera_rss_peak_bytes: Option<u64>,
    /// Arena of a device with its own memory, else 0.
    pub device_peak_bytes: u64,
    /// Shared memory of the frames.
    pub ipc_bytes: u64,
    /// Cap on host memory.
    pub budget_host_bytes: u64,
    /// Cap on device memory.
    pub budget_device_bytes: u64,
    /// The plan, row by row.
    pub plan: Vec<MemoryRow>,
    /// Allocations on sealed threads.
    pub sealed_allocations: u64,
    /// Elements that full containers turned away.
    pub refusals: u64,
    /// Growth of the resident size over the distance; null below 600 m.
    pub rss_slope_bytes_per_km: Option<f64>,
}

impl Memory {
    /// Caps, plan and refusals; what was measured is added by the caller.
    pub fn planned(plan: &Plan, usage: &Usage, budget_host_bytes: u64, budget_device_bytes: u64) -> Self {
        let row = |row: &crate::budget::PlanRow| MemoryRow {
            row: format!("{}.{}", row.row.spec().section, row.row.spec().name),
            bytes: row.bytes,
            used_peak: usage.peak(row.row).filter(|_| row.bytes_each > 0).map(|n| n.saturating_mul(row.bytes_each)),
            location: row.location.name().to_owned(),
            when_full: row.when_full.name().to_owned(),
        };
        Self {
            ipc_bytes: plan.ipc_bytes(),
            budget_host_bytes,
            budget_device_bytes,
            plan: plan.rows().iter().map(row).collect(),
            refusals: usage.refused_in_all(),
            ..Self::default()
        }
    }
}

/// One row of the memory plan.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MemoryRow {
    /// Name as in the budget file, `section.name`.
    pub row: String,
    /// Planned bytes.
    pub bytes: u64,
    /// Bytes of the most elements it ever held; unknown for what cannot be observed, has no bytes of its own or was
    /// not set up in this run.
    pub used_peak: Option<u64>,
    /// `host`, `device`, `both` or `ipc`.
    #[serde(rename = "where")]
    pub location: String,
    /// What happens when it is full.
    pub when_full: String,
}

/// What tracking did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Tracking {
    /// Frames with a pose from the essential matrix.
    pub essential: u64,
    /// Frames with a pose from PnP.
    pub pnp: u64,
    /// Frames with a pose from dense matches.
    pub dense_fallback: u64,
    /// Frames that motion verification left without a pose.
    pub anomalies: u64,
    /// Where metres come from.
    pub scale_source: Option<String>,
    /// Loop closures that were applied.
    pub loops: u64,
    /// Length of the final trajectory, m.
    pub path_length_m: f64,
}

/// What the map is; all zero or null when mapping is off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Mapping {
    /// Anchors in memory at the end.
    pub anchors_resident: u64,
    /// Anchors of the whole map.
    pub anchors_total: u64,
    /// Anchors that the full pool turned away.
    pub anchors_refused: u64,
    /// Decoded primitives with positive opacity seen from their spawning keyframe.
    pub gaussians: u64,
    /// Chunks of the map.
    pub chunks: u64,
    /// Pages written to disk.
    pub pages_written: u64,
    /// Pages read back.
    pub pages_returned: u64,
    /// Anchors and decoders on disk.
    pub map_bytes: u64,
    /// Everything in the store.
    pub store_bytes: u64,
    /// Mean over all mapping keyframes, rendered from the final stored map at native resolution.
    pub psnr_train_db: Option<f64>,
    /// The same as SSIM.
    pub ssim_train: Option<f64>,
    /// Mean over the frames that mapping never saw.
    pub psnr_heldout_db: Option<f64>,
    /// The same as SSIM.
    pub ssim_heldout: Option<f64>,
    /// Mean over the keyframes of the worst 100 m.
    pub psnr_worst_100m_db: Option<f64>,
}

/// What computed the splatting.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Backend {
    /// `cpu`, `vulkan` or `wgpu`; unknown when the map was never touched.
    pub kind: Option<String>,
    /// Name of the processor or device.
    pub device: Option<String>,
    /// Instruction set of the CPU kernels.
    pub simd: Option<String>,
    /// Worker threads.
    pub threads: u64,
}

impl Report {
    /// Writes `report.json` into the output folder, whole or not at all.
    ///
    /// # Errors
    /// [`OutputError`] when the disk does not take it.
    pub fn write(&self, dir: &Path) -> Result<(), OutputError> {
        let path = dir.join("report.json");
        kilogs_eval::replace_json(&path, self).map_err(OutputError::write(&path))
    }
}

#[cfg(test)]
#[path = "report_tests.rs"]
mod tests;
