//! Going on in a map that another drive made.

use crate::export::map_folder;
use crate::map_store::{HELD_OUT_PERIOD, MapStoreReader};
use crate::mapping::first_keyframe_id_after;
use crate::run_error::RunError;
use kilogs_core::conventions::{Rigid, rotation_from_xyzw};
use kilogs_core::store::StoredKeyframe;
use kilogs_core::tracking::FrameReport;
use nalgebra::{Translation3, Vector3};
use std::path::{Path, PathBuf};

/// Where a drive goes on in a map: what is tracked is in the odometry frame, what is mapped in the map's.
#[derive(Debug, Clone, PartialEq)]
pub struct Resume {
    /// Folder of the map, which is written in place.
    pub map: PathBuf,
    /// Where the odometry begins.
    pub map_from_odometry: Rigid,
    /// Somebody said where it begins.
    pub is_pose_given: bool,
    /// Id of the first keyframe.
    pub first_keyframe_id: u32,
    /// Index of the first frame, so that images have names of their own.
    pub first_frame_index: u64,
}

impl Resume {
    /// Goes on where the last drive ended, or from `map_from_camera`.
    ///
    /// # Errors
    /// [`RunError::Store`] when there is no map that can be read, [`RunError::Usage`] when nothing says where to begin.
    pub fn open(given: &Path, map_from_camera: Option<Rigid>, max_views: usize) -> Result<Self, RunError> {
        let map = map_folder(given);
        let stored = MapStoreReader::open(&map, max_views)?;
        for damage in stored.damages() {
            log::warn!("going on with the map {}: {damage}; it is left out", map.display());
        }
        let last = stored.keyframes().last().map(map_from_keyframe);
        let Some(map_from_odometry) = map_from_camera.or(last) else {
            return Err(RunError::Usage(format!(
                "going on with the map {}: it has no keyframe to begin at; give --resume-pose, or begin a new map",
                map.display()
            )));
        };
        let views = stored.keyframes().iter().chain(stored.held_out());
        let n_frames = views.map(|view| view.frame_index + 1).max().unwrap_or(0);
        Ok(Self {
            first_keyframe_id: first_keyframe_id_after(&stored),
            // Every eighth frame judges the map, counted from its first.
            first_frame_index: n_frames.next_multiple_of(HELD_OUT_PERIOD),
            map_from_odometry,
            is_pose_given: map_from_camera.is_some(),
            map,
        })
    }

    /// A frame as the map sees it.
    pub fn in_map(&self, report: &FrameReport) -> FrameReport {
        FrameReport {
            frame_index: self.first_frame_index + report.frame_index,
            keyframe_ordinal: self.first_keyframe_id + report.keyframe_ordinal,
            world_from_camera: self.map_from_odometry * report.world_from_camera,
            ..*report
        }
    }
}

/// Where a stored keyframe is.
pub fn map_from_keyframe(keyframe: &StoredKeyframe) -> Rigid {
    let translation_m = Vector3::from(keyframe.translation_m);
    Rigid::from_parts(Translation3::from(translation_m), rotation_from_xyzw(keyframe.rotation_xyzw))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_without_a_readable_map_ends_with_the_code_of_the_map_store() {
        let folder = tempfile::tempdir().expect("a folder");
        let code = || Resume::open(folder.path(), None, 100).expect_err("no map").code();
        assert_eq!(code(), 5, "nothing there");
        std::fs::write(folder.path().join("manifest.kgs"), [9; 300]).expect("written");
        assert_eq!(code(), 5, "a manifest of something else");
    }
}
