//! Posed images: what a map is fitted to.

use super::{kitti, transforms};
use kilogs_camera::source::{ImageList, PixelFormat, SourceError, SourceFormat};
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::conventions::{Rigid, TimestampNs};
use nalgebra::{Matrix3, Point3, Rotation3, UnitQuaternion};
use std::path::{Path, PathBuf};

/// Where the scene is, and how much of it to take.
#[derive(Debug, Clone, Copy)]
pub struct SceneRequest<'a> {
    /// `transforms.json`, the folder that holds it, or a recording in KITTI's layout.
    pub scene: &'a Path,
    /// Poses of a recording, 12 numbers a line.
    pub poses: Option<&'a Path>,
    /// `kitti` or a `camera.toml`, for recordings.
    pub camera: Option<&'a str>,
    /// Views to take at most.
    pub frames: Option<usize>,
}

/// Images with the places they were taken from, in the order of their taking.
pub struct Scene {
    /// Size and intrinsics of every image.
    pub camera: Pinhole,
    /// How the camera sits on its vehicle, where that is known.
    pub mounting: Option<Mounting>,
    /// The images.
    pub images: ImageList,
    /// One per image; the first is the origin of the world.
    pub views: Vec<PosedView>,
    /// Surface points that came with the scene, in the same world, m.
    pub points: Vec<Point3<f64>>,
}

/// Where and when an image was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PosedView {
    /// Where the camera was.
    pub world_from_camera: Rigid,
    /// Middle of the exposure; by the image's number where the scene knows no time.
    pub timestamp_ns: TimestampNs,
}

/// Why posed images cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SceneError {
    /// A file of the scene is missing or cannot be believed; the text names it and says what to try.
    #[error("reading {}: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and what to try.
        reason: String,
    },
    /// The images, their times or their calibration.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The pose file.
    #[error(transparent)]
    Poses(#[from] kilogs_eval::command::EvalError),
}

impl SceneError {
    pub(crate) fn file(path: &Path, reason: impl Into<String>) -> Self {
        Self::File { path: path.to_owned(), reason: reason.into() }
    }

    /// The exit code of contracts.md.
    pub fn code(&self) -> u8 {
        match self {
            Self::File { .. } | Self::Poses(_) => 3,
            Self::Source(SourceError::Range(_) | SourceError::LeftOut { .. }) => 3,
            Self::Source(SourceError::Camera { .. }) => 2,
            Self::Source(SourceError::File { .. }) => 3,
        }
    }
}

/// Interval of the times that are made up for a scene without any: those of 10 images per second.
pub(super) const MADE_UP_INTERVAL_NS: TimestampNs = 100_000_000;

/// Fewer views than this show no depth.
const MIN_VIEWS: usize = 2;

impl Scene {
    /// Finds images, cameras and poses.
    ///
    /// # Errors
    /// [`SceneError`] names the file that is missing or wrong.
    pub fn open(request: &SceneRequest<'_>) -> Result<Self, SceneError> {
        let file = match request.scene.is_dir() {
            true => request.scene.join(transforms::FILE_NAME),
            false => request.scene.to_owned(),
        };
        let mut scene = match request.poses {
            Some(poses) => kitti::open(request, poses)?,
            None if file.is_file() => transforms::open(&file, request.frames)?,
            None => {
                let reason = if request.scene.is_dir() {
                    "there is no transforms.json in it; for a recording in KITTI's layout give --poses FILE"
                } else {
                    "there is no such file or folder; give a transforms.json, its folder, or a recording with --poses"
                };
                return Err(SceneError::file(request.scene, reason));
            }
        };
        if scene.views.len() < MIN_VIEWS {
            let reason = format!("{} view; at least {MIN_VIEWS} are needed", scene.views.len());
            return Err(SceneError::file(request.scene, reason));
        }
        scene.begin_at_first_view();
        Ok(scene)
    }

    /// What the images look like, in the words of a camera.
    pub fn format(&self) -> SourceFormat {
        SourceFormat {
            camera: self.camera,
            mounting: self.mounting,
            pixel_format: self.images.pixel_format(),
            n_frames: Some(self.views.len() as u64),
        }
    }

    /// Layout of the pixels.
    pub fn pixel_format(&self) -> PixelFormat {
        self.images.pixel_format()
    }

    /// The world is the first camera's frame.
    fn begin_at_first_view(&mut self) {
        let Some(first) = self.views.first() else { return };
        let first_from_world = first.world_from_camera.inverse();
        for view in &mut self.views {
            view.world_from_camera = first_from_world * view.world_from_camera;
        }
        for point in &mut self.points {
            *point = first_from_world * *point;
        }
    }
}

/// What to do about a pose that is none.
pub(super) const MEND_POSE: &str = "correct the pose, or leave the image out";

/// Largest entry of `R^T R - I`: files carry about seven digits; what is further off is no rotation.
const MAX_ROTATION_ERROR: f64 = 1e-2;

/// The rotation that a matrix was rounded from for printing.
///
/// # Errors
/// What is wrong with it, in words.
pub(super) fn rotation_of(written: &Matrix3<f64>) -> Result<UnitQuaternion<f64>, String> {
    if written.iter().any(|value| !value.is_finite()) {
        return Err(format!("holds a number that is not finite; {MEND_POSE}"));
    }
    let error = (written.transpose() * written - Matrix3::identity()).abs().max();
    if error > MAX_ROTATION_ERROR || written.determinant() <= 0.0 {
        return Err(format!(
            "does not hold a rotation (R^T R differs from 1 by {error:.2e}, determinant {:.3}); {MEND_POSE}",
            written.determinant()
        ));
    }
    Ok(UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix(written)))
}

impl From<SceneError> for crate::run_error::RunError {
    fn from(error: SceneError) -> Self {
        match error {
            SceneError::Source(source) => source.into(),
            other => Self::Input(other.to_string()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_rotation_is_said_to_be_none() {
        let check = |entries: [f64; 9], expected: &str| {
            let reason = rotation_of(&Matrix3::from_row_slice(&entries)).expect_err("no rotation");
            assert!(reason.contains(expected), "{reason}");
        };
        check([f64::NAN, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "not finite");
        check([2.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "differs from 1 by 3");
        check([1.0, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], "differs from 1 by 5.00e-1");
        check([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0], "determinant -1");
        let turned = rotation_of(&Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0)).expect("a rotation");
        assert!((turned.angle() - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
    }
}
