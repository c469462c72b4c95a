//! The payloads of the services.

use iceoryx2::prelude::ZeroCopySend;
use kilogs_core::conventions::TimestampNs;
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

/// Bytes of one page of pixels.
pub const PAGE_BYTES: usize = 4096;

/// One page of pixels; a frame is a slice of them, so that it starts on a page of memory.
///
/// The two `repr` attributes stand apart because the derive of `ZeroCopySend` does not read a combined one.
#[derive(Clone, Copy, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[repr(align(4096))]
#[type_name("KilogsFramePage1")]
pub struct FramePage {
    /// Pixels, row by row, across pages without gaps.
    pub bytes: [u8; PAGE_BYTES],
}
const _: () = assert!(size_of::<FramePage>() == PAGE_BYTES && align_of::<FramePage>() == PAGE_BYTES);

impl FramePage {
    /// Pages that `n_bytes` fill.
    pub const fn needed_for(n_bytes: u64) -> usize {
        n_bytes.div_ceil(PAGE_BYTES as u64) as usize
    }
}

impl Default for FramePage {
    fn default() -> Self {
        Self { bytes: [0; PAGE_BYTES] }
    }
}

impl std::fmt::Debug for FramePage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("FramePage")
    }
}

/// The tracker is done with this frame and all before it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[type_name("KilogsAck1")]
pub struct Ack {
    /// Sequence number of the frame.
    pub sequence: u64,
}

/// How fast the vehicle drives, from its wheels.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[type_name("KilogsSpeed1")]
pub struct Speed {
    /// When it was measured, on the camera's clock.
    pub timestamp_ns: TimestampNs,
    /// Forward speed; negative in reverse gear.
    pub metres_per_second: f64,
    /// Standard deviation of the speed, m/s.
    pub standard_deviation: f64,
}

/// Where the vehicle's camera is, per frame.
///
/// Transforms are a translation in metres and a quaternion `[x, y, z, w]` with `w >= 0`.
#[derive(Clone, Copy, Debug, PartialEq, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[type_name("KilogsOdometry1")]
pub struct OdometryMessage {
    /// Index of the frame in the run, missing ones included.
    pub sequence: u64,
    /// Middle of the exposure.
    pub timestamp_ns: TimestampNs,
    /// 0 tracked, 1 doubtful, 2 lost.
    pub status: u32,
    /// 1 when the frame became a keyframe.
    pub is_keyframe: u32,
    /// Translation of `odometry_from_camera`, m. The odometry frame never jumps.
    pub odometry_from_camera_m: [f64; 3],
    /// Rotation of `odometry_from_camera`.
    pub odometry_from_camera_xyzw: [f64; 4],
    /// Translation of `map_from_odometry`, m. Changes when a loop is closed.
    pub map_from_odometry_m: [f64; 3],
    /// Rotation of `map_from_odometry`.
    pub map_from_odometry_xyzw: [f64; 4],
    /// Scale of `map_from_odometry`; 1 until a loop closure corrects it.
    pub map_from_odometry_scale: f64,
    /// Velocity of the camera in its own axes, m/s.
    pub velocity_in_camera_m_per_s: [f64; 3],
    /// `[6, 6]` covariance of `odometry_from_camera` since the first frame, row by row: three rotations (rad), then
    /// three translations (m), both along the fixed axes of the odometry frame. The true rotation is
    /// `exp(theta) * R`, the true position `p` further than the estimated one. It is that of ROS's `nav_msgs/Odometry`
    /// but for the order: ROS has translations first. Always positive definite; grows with the way driven, and with
    /// time while frames are doubtful or lost.
    pub covariance: [f64; 36],
}

/// Nothing known: all numbers 0, both transforms the identity.
impl Default for OdometryMessage {
    fn default() -> Self {
        Self {
            odometry_from_camera_xyzw: [0.0, 0.0, 0.0, 1.0],
            map_from_odometry_xyzw: [0.0, 0.0, 0.0, 1.0],
            map_from_odometry_scale: 1.0,
            ..Self::new_zeroed()
        }
    }
}

/// How the program is, per second.
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
#[type_name("KilogsHealth1")]
pub struct HealthMessage {
    /// Seconds since the start of the program.
    pub uptime_s: f64,
    /// Resident memory of this process.
    pub rss_bytes: u64,
    /// The most it ever was.
    pub rss_peak_bytes: u64,
    /// What the budget allows on the host.
    pub budget_host_bytes: u64,
    /// Device memory in use.
    pub device_bytes: u64,
    /// Shared memory of the frame slots.
    pub ipc_bytes: u64,
    /// Size of the map store on disk.
    pub store_bytes: u64,
    /// Frames that arrived and could be used, or are known to be missing.
    pub frames_received: u64,
    /// Of these: tracked.
    pub frames_tracked: u64,
    /// Of these: with a predicted pose.
    pub frames_doubtful: u64,
    /// Of these: lost.
    pub frames_lost: u64,
    /// Of these: never reached the tracker.
    pub frames_dropped: u64,
    /// Frames whose header was refused.
    pub frames_refused: u64,
    /// The same as `frames_dropped`: overwritten or never sent, by their sequence numbers.
    pub frames_missing: u64,
    /// Heap allocations on a sealed thread.
    pub sealed_allocations: u64,
    /// Times that something was full and said so.
    pub refusals: u64,
    /// Anchors in memory.
    pub anchors_resident: u64,
    /// Median tracking time since the start, ms.
    pub tracking_p50_ms: f32,
    /// 95th percentile, ms.
    pub tracking_p95_ms: f32,
    /// Longest since the start, ms.
    pub tracking_max_ms: f32,
    /// Mapping iterations per second.
    pub mapping_it_per_s: f32,
    /// 0 not come yet, 1 sending, 2 silent, 3 gone, 4 stream complete.
    pub camera_state: u32,
    /// How often the camera process came back.
    pub camera_restarts: u32,
}
const _: () = assert!(size_of::<HealthMessage>() == 16 * 8 + 8 + 6 * 4);
