//! A recording in KITTI's layout with a pose for every image.

use crate::pose_file::PoseFile;

use super::scene::{MADE_UP_INTERVAL_NS, PosedView, Scene, SceneError, SceneRequest};
use kilogs_camera::source::{ImageList, describe};
use kilogs_core::conventions::Rigid;
use std::path::{Path, PathBuf};

/// Reads the recording and its poses.
///
/// # Errors
/// [`SceneError`] names the file that is missing or wrong.
pub(super) fn open(request: &SceneRequest<'_>, poses: &Path) -> Result<Scene, SceneError> {
    let has_times = request.scene.join("times.txt").is_file();
    let made_up_fps = 1e9 / MADE_UP_INTERVAL_NS as f64;
    let described = describe(request.scene, request.camera, (!has_times).then_some(made_up_fps))?;
    let n_views = request.frames.map_or(described.images.len(), |frames| frames.min(described.images.len()));
    let world_from_camera = poses_of(poses, &described.images, n_views)?;
    let images = ImageList::open(described.images.into_iter().take(n_views).collect())?.rectified(described.distortion);
    let views = world_from_camera.into_iter().zip(described.timestamps_ns);
    Ok(Scene {
        camera: described.format.camera,
        mounting: described.format.mounting,
        images,
        views: views.map(|(world_from_camera, timestamp_ns)| PosedView { world_from_camera, timestamp_ns }).collect(),
        points: Vec::new(),
    })
}

/// Poses of the first `n_views` of `images`.
fn poses_of(path: &Path, images: &[PathBuf], n_views: usize) -> Result<Vec<Rigid>, SceneError> {
    let mut file = PoseFile::open(path)?;
    let pose = |k: usize| {
        let line = line_of(path, file.n_poses(), images, k)?;
        file.pose(line)?.ok_or_else(|| SceneError::file(path, "it has become shorter meanwhile; try again"))
    };
    (0..n_views).map(pose).collect()
}

/// Line of a pose file that belongs to image `k`, both counted from 0: line k is image k, or, where the recording is a
/// part of a longer one, the image with number k.
///
/// # Errors
/// [`SceneError`] when there is no such line.
pub fn line_of(path: &Path, n_poses: u64, images: &[PathBuf], k: usize) -> Result<u64, SceneError> {
    let number = |path: &PathBuf| path.file_stem()?.to_str()?.parse::<u64>().ok();
    let line = if n_poses == images.len() as u64 { Some(k as u64) } else { images.get(k).and_then(number) };
    line.filter(|&line| line < n_poses).ok_or_else(|| {
        let name = images.get(k).and_then(|image| image.file_name()).unwrap_or_default().display();
        let reason = format!(
            "{n_poses} poses for {} images, and none for {name}; give a line for every image, or fewer --frames",
            images.len()
        );
        SceneError::file(path, reason)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(n_poses: usize, names: &[&str], n_views: usize, expected: Result<&[f64], &str>) {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("poses.txt");
        let lines = (0..n_poses).map(|k| format!("1 0 0 {k} 0 1 0 0 0 0 1 0\n"));
        std::fs::write(&path, lines.collect::<String>()).expect("a file");
        let images: Vec<PathBuf> = names.iter().map(PathBuf::from).collect();
        let found = poses_of(&path, &images, n_views).map_err(|e| e.to_string());
        match (found, expected) {
            (Ok(found), Ok(expected)) => {
                assert_eq!(found.iter().map(|pose| pose.translation.x).collect::<Vec<_>>(), expected);
            }
            (Err(reason), Err(part)) => assert!(reason.contains(part), "{reason}"),
            (found, _) => panic!("{found:?} instead of {expected:?}"),
        }
    }

    #[test]
    fn poses_go_to_images_by_order_or_by_number() {
        check(2, &["000007.png", "000008.png"], 2, Ok(&[0.0, 1.0]));
        check(9, &["000007.png", "000008.png"], 2, Ok(&[7.0, 8.0]));
        check(2, &["0.png", "1.png", "2.png"], 2, Ok(&[0.0, 1.0]));
        check(2, &["0.png", "1.png", "2.png"], 3, Err("2 poses for 3 images, and none for 2.png"));
        check(3, &["a.png", "b.png"], 1, Err("none for a.png"));
        check(0, &["0.png"], 1, Err("none for 0.png"));
    }
}
