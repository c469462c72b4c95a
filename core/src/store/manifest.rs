//! The manifest: what every part of a map has in common.

use super::record::{self, PREFIX_BYTES, RecordKind, RecordProblem};
use crate::camera::{Mounting, Pinhole};
use crate::frame::PixelFormat;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Most levels of detail that a map can have.
pub const MAX_LEVELS: usize = 8;

/// How much a complete map holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct MapCounts {
    /// Mapping keyframes.
    pub keyframes: u64,
    /// Held-out views.
    pub held_out: u64,
    /// Images of either.
    pub images: u64,
    /// Chunks.
    pub chunks: u64,
    /// Pages.
    pub pages: u64,
    /// Anchors in all pages.
    pub anchors: u64,
    /// Gaussians in all pages.
    pub gaussians: u64,
}

/// What every part of a map has in common.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Manifest {
    /// Camera at the size of the stored images.
    pub camera: Pinhole,
    /// How the camera sits on the vehicle, where that was known.
    pub mounting: Option<Mounting>,
    /// Format in which the camera delivered; images are stored as JPEG.
    pub pixel_format: PixelFormat,
    /// Edge of a voxel per level, m, finest first; levels that are not used are 0.
    pub voxel_m: [f32; MAX_LEVELS],
    /// Levels in use.
    pub n_levels: u32,
    /// Most Gaussians that one anchor may have.
    pub gaussians_per_anchor: u32,
    /// Counts, once the map is complete; `None` while it is being written or when writing was interrupted.
    pub counts: Option<MapCounts>,
}

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct ManifestBody {
    intrinsics: [f64; 4],
    /// Height, pitch, roll, forward axis, lever arm.
    mounting: [f64; 9],
    counts: MapCounts,
    voxel_m: [f32; MAX_LEVELS],
    width: u32,
    height: u32,
    pixel_format: u32,
    n_levels: u32,
    gaussians_per_anchor: u32,
    has_mounting: u32,
    is_complete: u32,
    reserved: u32,
}

/// Length of a manifest file.
pub const MANIFEST_BYTES: usize = PREFIX_BYTES + size_of::<ManifestBody>();

/// The manifest's bytes.
pub fn encode_manifest(manifest: &Manifest) -> [u8; MANIFEST_BYTES] {
    let camera = &manifest.camera;
    let body = ManifestBody {
        intrinsics: [camera.fx, camera.fy, camera.cx, camera.cy],
        mounting: manifest.mounting.as_ref().map_or([0.0; 9], mounting_to_array),
        counts: manifest.counts.unwrap_or_default(),
        voxel_m: manifest.voxel_m,
        width: camera.width,
        height: camera.height,
        pixel_format: manifest.pixel_format as u32,
        n_levels: manifest.n_levels,
        gaussians_per_anchor: manifest.gaussians_per_anchor,
        has_mounting: u32::from(manifest.mounting.is_some()),
        is_complete: u32::from(manifest.counts.is_some()),
        reserved: 0,
    };
    let mut bytes = [0; MANIFEST_BYTES];
    let written = record::write(RecordKind::Manifest, &body, &mut bytes);
    debug_assert_eq!(written, Some(MANIFEST_BYTES));
    bytes
}

/// Verifies a manifest.
///
/// # Errors
/// [`RecordProblem`] when it is damaged or describes no camera; the map cannot be opened then.
pub fn decode_manifest(bytes: &[u8]) -> Result<Manifest, RecordProblem> {
    const WRONG: RecordProblem = RecordProblem::Inconsistent { element: 0 };
    let body: ManifestBody = record::open_as(RecordKind::Manifest, bytes)?;
    let [fx, fy, cx, cy] = body.intrinsics;
    let finite = body.intrinsics.iter().chain(&body.mounting).all(|value| value.is_finite());
    let sized = body.width > 0 && body.height > 0 && fx > 0.0 && fy > 0.0;
    if !finite || !sized || body.n_levels as usize > MAX_LEVELS || body.gaussians_per_anchor == 0 {
        return Err(WRONG);
    }
    Ok(Manifest {
        camera: Pinhole { width: body.width, height: body.height, fx, fy, cx, cy },
        mounting: (body.has_mounting == 1).then(|| mounting_from_array(body.mounting)),
        pixel_format: pixel_format_from_wire(body.pixel_format).ok_or(WRONG)?,
        voxel_m: body.voxel_m,
        n_levels: body.n_levels,
        gaussians_per_anchor: body.gaussians_per_anchor,
        counts: (body.is_complete == 1).then_some(body.counts),
    })
}

fn mounting_to_array(mounting: &Mounting) -> [f64; 9] {
    let [fx, fy, fz] = mounting.forward_axis;
    let [lx, ly, lz] = mounting.lever_arm_m;
    [mounting.height_m, mounting.pitch_rad, mounting.roll_rad, fx, fy, fz, lx, ly, lz]
}

fn mounting_from_array(values: [f64; 9]) -> Mounting {
    let [height_m, pitch_rad, roll_rad, fx, fy, fz, lx, ly, lz] = values;
    Mounting { height_m, pitch_rad, roll_rad, forward_axis: [fx, fy, fz], lever_arm_m: [lx, ly, lz] }
}

fn pixel_format_from_wire(number: u32) -> Option<PixelFormat> {
    use PixelFormat::{BayerRggb8, Bgr8, Mono8, Nv12, Rgb8, Yuyv};
    [Mono8, Rgb8, Bgr8, Nv12, Yuyv, BayerRggb8].into_iter().find(|format| *format as u32 == number)
}

#[cfg(test)]
mod tests {
    use super::super::record::{STORE_VERSION, as_next_version, check_every_damage_is_noticed};
    use super::*;

    const MANIFEST: Manifest = Manifest {
        camera: Pinhole { width: 1241, height: 376, fx: 718.856, fy: 718.856, cx: 607.6928, cy: 185.7157 },
        mounting: Some(Mounting {
            height_m: 1.65,
            pitch_rad: 0.01,
            roll_rad: -0.02,
            forward_axis: [0.0, 0.0, 1.0],
            lever_arm_m: [0.0, 1.3, -1.7],
        }),
        pixel_format: PixelFormat::Bgr8,
        voxel_m: [0.1, 0.25, 1.0, 5.0, 25.0, 0.0, 0.0, 0.0],
        n_levels: 5,
        gaussians_per_anchor: 10,
        counts: Some(MapCounts { keyframes: 1, held_out: 2, images: 3, chunks: 4, pages: 5, anchors: 6, gaussians: 7 }),
    };

    #[test]
    fn a_manifest_comes_back_and_no_damage_passes() {
        for manifest in [MANIFEST, Manifest { mounting: None, counts: None, ..MANIFEST }] {
            let bytes = encode_manifest(&manifest);
            assert_eq!(decode_manifest(&bytes), Ok(manifest));
            check_every_damage_is_noticed(&bytes, |bytes| decode_manifest(bytes).map(|_| ()));
            assert_eq!(
                decode_manifest(&as_next_version(&bytes)),
                Err(RecordProblem::Version { found: STORE_VERSION + 1 })
            );
        }
    }

    #[test]
    fn a_manifest_without_a_camera_is_refused() {
        let blind = Manifest { camera: Pinhole { width: 0, ..MANIFEST.camera }, ..MANIFEST };
        assert_eq!(decode_manifest(&encode_manifest(&blind)), Err(RecordProblem::Inconsistent { element: 0 }));
    }
}
