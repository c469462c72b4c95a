//! nerfstudio's `transforms.json`: a pinhole camera, images with OpenGL poses, and points where it names some.

use super::points;
use super::scene::{MADE_UP_INTERVAL_NS, MEND_POSE, PosedView, Scene, SceneError, rotation_of};
use kilogs_camera::source::ImageList;
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use nalgebra::{Matrix3, Translation3, UnitQuaternion, Vector3};
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Name of the file in its folder.
pub(super) const FILE_NAME: &str = "transforms.json";

/// What the file may say that is of interest here; per image the same names override what stands above.
#[derive(Debug, Clone, Copy, Default, Deserialize)]
struct TypedCamera {
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    camera_angle_x: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

#[derive(Debug, Deserialize)]
struct TypedScene {
    #[serde(flatten)]
    camera: TypedCamera,
    camera_model: Option<String>,
    ply_file_path: Option<PathBuf>,
    frames: Vec<TypedFrame>,
}

#[derive(Debug, Deserialize)]
struct TypedFrame {
    file_path: PathBuf,
    transform_matrix: Vec<Vec<f64>>,
    #[serde(flatten)]
    camera: TypedCamera,
}

/// Lens models whose coefficients may all be zero.
const CAMERA_MODELS: [&str; 4] = ["PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE"];

/// Reads the scene; views come in the order of their names.
///
/// # Errors
/// [`SceneError`] names the file, and the image where one is wrong.
pub(super) fn open(path: &Path, frames: Option<usize>) -> Result<Scene, SceneError> {
    let wrong = |reason: String| SceneError::file(path, reason);
    let text =
        std::fs::read_to_string(path).map_err(|e| wrong(format!("{e}; give a transforms.json that can be read")))?;
    let mut typed: TypedScene = serde_json::from_str(&text)
        .map_err(|e| wrong(format!("{e}; expected nerfstudio's transforms.json with fl_x, fl_y, cx, cy and frames")))?;
    if typed.frames.is_empty() {
        return Err(wrong("frames is empty; list at least two images".to_owned()));
    }
    if let Some(model) = typed.camera_model.as_deref().filter(|model| !CAMERA_MODELS.contains(model)) {
        return Err(wrong(format!("camera_model {model} is not a pinhole; undistort the images first")));
    }
    typed.frames.sort_by_cached_key(|frame| natural_key(&frame.file_path));
    typed.frames.truncate(frames.unwrap_or(usize::MAX));
    let folder = path.parent().unwrap_or(Path::new("."));
    let images = ImageList::open(typed.frames.iter().map(|frame| image_path(folder, &frame.file_path)).collect())?;
    let camera = common_camera(&typed, images.size()).map_err(wrong)?;
    let mut views = Vec::with_capacity(typed.frames.len());
    for (frame, nth) in typed.frames.iter().zip(0..) {
        let world_from_camera = pose(frame)
            .map_err(|reason| wrong(format!("transform_matrix of {} {reason}", frame.file_path.display())))?;
        views.push(PosedView { world_from_camera, timestamp_ns: nth * MADE_UP_INTERVAL_NS });
    }
    let points = typed.ply_file_path.map_or_else(|| Ok(Vec::new()), |ply| points::read(&folder.join(ply)))?;
    Ok(Scene { camera, mounting: None, images, views, points })
}

/// Name without its digits, then its last number: `frame_2` before `frame_10`.
fn natural_key(path: &Path) -> (PathBuf, String, u64, PathBuf) {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let digits = stem.len() - stem.trim_end_matches(|c: char| c.is_ascii_digit()).len();
    let (name, number) = stem.split_at(stem.len() - digits);
    let parent = path.parent().unwrap_or(Path::new("")).to_owned();
    (parent, name.to_owned(), number.parse().unwrap_or(0), path.to_owned())
}

/// Synthetic scenes leave the extension out.
fn image_path(folder: &Path, file_path: &Path) -> PathBuf {
    let path = folder.join(file_path);
    let with = |extension: &str| PathBuf::from(format!("{}.{extension}", path.display()));
    let known = ["png", "jpg", "jpeg"].into_iter().map(with).find(|candidate| candidate.is_file());
    if path.is_file() { path } else { known.unwrap_or(path) }
}

fn common_camera(typed: &TypedScene, size: [u32; 2]) -> Result<Pinhole, String> {
    let first = typed.frames.first().map(|frame| frame.camera).unwrap_or_default();
    let camera = typed.camera.overridden(&first).pinhole(size)?;
    for frame in &typed.frames {
        if typed.camera.overridden(&frame.camera).pinhole(size)? != camera {
            let name = frame.file_path.display();
            return Err(format!("{name} has other intrinsics than the first image; split the scene by camera"));
        }
    }
    Ok(camera)
}

impl TypedCamera {
    fn overridden(&self, by: &Self) -> Self {
        Self {
            fl_x: by.fl_x.or(self.fl_x),
            fl_y: by.fl_y.or(self.fl_y),
            cx: by.cx.or(self.cx),
            cy: by.cy.or(self.cy),
            w: by.w.or(self.w),
            h: by.h.or(self.h),
            camera_angle_x: by.camera_angle_x.or(self.camera_angle_x),
            k1: by.k1.or(self.k1),
            k2: by.k2.or(self.k2),
            k3: by.k3.or(self.k3),
            k4: by.k4.or(self.k4),
            p1: by.p1.or(self.p1),
            p2: by.p2.or(self.p2),
        }
    }

    /// Pixel centres are at +0.5 here and there.
    fn pinhole(&self, [width, height]: [u32; 2]) -> Result<Pinhole, String> {
        let coefficients = [self.k1, self.k2, self.k3, self.k4, self.p1, self.p2];
        if coefficients.into_iter().flatten().any(|coefficient| coefficient != 0.0) {
            return Err("the lens distorts (k1, k2, k3, k4, p1 or p2 is not 0); undistort the images first".to_owned());
        }
        let typed_size = [self.w.unwrap_or(width.into()), self.h.unwrap_or(height.into())];
        if typed_size != [f64::from(width), f64::from(height)] {
            let [w, h] = typed_size;
            return Err(format!(
                "w and h are {w}x{h}, the images have {width}x{height} px; correct w, h, fl_x, fl_y, cx and cy"
            ));
        }
        let from_angle = self.camera_angle_x.map(|angle_rad| 0.5 * f64::from(width) / (0.5 * angle_rad).tan());
        let Some(fx) = self.fl_x.or(from_angle) else {
            return Err("there is neither fl_x nor camera_angle_x; add fl_x, the focal length in px".to_owned());
        };
        let fy = self.fl_y.unwrap_or(fx);
        let (cx, cy) = (self.cx.unwrap_or(0.5 * f64::from(width)), self.cy.unwrap_or(0.5 * f64::from(height)));
        let is_inside = (0.0..=f64::from(width)).contains(&cx) && (0.0..=f64::from(height)).contains(&cy);
        if !(fx.is_finite() && fy.is_finite() && fx > 0.0 && fy > 0.0 && is_inside) {
            return Err(format!(
                "fl_x {fx}, fl_y {fy}, cx {cx}, cy {cy} are no camera of {width}x{height} px; correct them"
            ));
        }
        Ok(Pinhole { width, height, fx, fy, cx, cy })
    }
}

/// OpenGL cameras look along -z with y up; ours look along z with y down.
fn pose(frame: &TypedFrame) -> Result<Rigid, String> {
    let rows = &frame.transform_matrix;
    if !(rows.len() == 4 || rows.len() == 3) || rows.iter().any(|row| row.len() != 4) {
        return Err("is not 4x4; write four rows of four numbers".to_owned());
    }
    let at = |row: usize, column: usize| rows[row][column];
    let rotation = rotation_of(&Matrix3::from_fn(at))?;
    let translation = Vector3::from_fn(|row, _| at(row, 3));
    if translation.iter().any(|value| !value.is_finite()) {
        return Err(format!("holds a number that is not finite; {MEND_POSE}"));
    }
    let gl_from_ours = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    Ok(Rigid::from_parts(Translation3::from(translation), rotation * gl_from_ours))
}
