//! What stands in the way: a Gaussian that is slim in its own keyframe's view fills that of a camera which comes near to it,
//! and is fog to whoever passes there.

use super::images::pixel_index;
use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use super::pages::point_in_map;
use super::prune::{center_in_keyframe_m, largest_sigma_m, max_sigma_z1};
use super::settings::MapperSettings;
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use kilogs_core::map::voxel::VoxelKey;
use nalgebra::{Point3, Vector3};

/// Voxels farther away than this do not fill a view, m: there, a Gaussian of the finest level would have grown to more than ten
/// times its voxel.
const NEAR_M: f64 = 10.0;

impl Mapper {
    /// Drops the Gaussians that fill the newest keyframe's view. Those of finished chunks stay, as all of them does.
    pub(super) fn prune_in_the_way(&mut self) {
        let Some(newest) = self.images.newest(0).map(|kept| kept.keyframe) else { return };
        let view = NearView::of(&self.settings, self.images.camera(), &newest.world_from_camera);
        for chunk in self.first_unfinished_chunk()..=newest.ordinal / CHUNK_KEYFRAMES {
            self.read_decoder(chunk);
            let mut next_slot = Some(0);
            while let Some(first_slot) = next_slot {
                next_slot = self.stage(first_slot, |record| {
                    record.keyframe_ordinal / CHUNK_KEYFRAMES == chunk && view.may_be_filled_from(record.voxel)
                });
                self.read_staged();
                self.prune_staged(|placement, header, gaussian| {
                    let center_m = Vector3::from(center_in_keyframe_m(header, gaussian)).cast::<f64>();
                    let sigma_m = placement.scale * f64::from(largest_sigma_m(header, gaussian));
                    !view.is_filled_by(&point_in_map(placement, center_m), sigma_m)
                });
                self.staging.clear();
            }
        }
    }
}

/// What is right in front of a camera.
struct NearView {
    camera: Pinhole,
    camera_from_map: Rigid,
    /// Largest standard deviation over depth that fills no more of the view than it may.
    max_sigma_z1: f64,
}

impl NearView {
    fn of(settings: &MapperSettings, camera: &Pinhole, world_from_camera: &Rigid) -> Self {
        let max_sigma_z1 = max_sigma_z1(settings, camera).into();
        Self { camera: *camera, camera_from_map: world_from_camera.inverse(), max_sigma_z1 }
    }

    /// Whether Gaussians in a voxel may fill the view: those that are near and in front.
    fn may_be_filled_from(&self, voxel: VoxelKey) -> bool {
        let in_camera = self.camera_from_map * Point3::from(voxel.center_in_map_m());
        voxel.level() == 0 && in_camera.z > 0.0 && in_camera.coords.norm() < NEAR_M
    }

    /// Whether a Gaussian whose centre is in view is too wide for its depth.
    fn is_filled_by(&self, center_in_map_m: &[f64; 3], sigma_m: f64) -> bool {
        let in_camera_m = (self.camera_from_map * Point3::from(*center_in_map_m)).coords;
        let pixel = self.camera.project(&in_camera_m).and_then(|place_px| pixel_index(&self.camera, &place_px));
        pixel.is_some() && sigma_m > self.max_sigma_z1 * in_camera_m.z
    }
}
