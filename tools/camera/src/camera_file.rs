//! `camera.toml`: what the operator knows about the camera, and the built-in preset.

use std::path::{Path, PathBuf};

use kilogs_core::camera::{Lens, Mounting, Pinhole};
use serde::Deserialize;

use crate::source::SourceError;

/// The name under which a camera file lies beside the images.
pub const CAMERA_FILE_NAME: &str = "camera.toml";

/// KITTI's cameras: 1.65 m over the road, axes aligned with the vehicle (Geiger et al., IJRR 2013, fig. 3).
pub const KITTI_MOUNTING: Mounting = Mounting { height_m: 1.65, ..LEVEL };

const LEVEL: Mounting =
    Mounting { height_m: 0.0, pitch_rad: 0.0, roll_rad: 0.0, forward_axis: [0.0, 0.0, 1.0], lever_arm_m: [0.0; 3] };

/// Focal lengths and principal point, px; pixel centres at +0.5.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point.
    pub cx: f64,
    /// Principal point.
    pub cy: f64,
}

/// What `--camera` says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum CameraArgument {
    /// `kitti`: [`KITTI_MOUNTING`], intrinsics from the data set.
    Kitti,
    /// A `camera.toml`.
    File(PathBuf),
}

impl From<&str> for CameraArgument {
    fn from(text: &str) -> Self {
        match text {
            "kitti" => Self::Kitti,
            path => Self::File(path.into()),
        }
    }
}

/// A camera file as checked: everything it gives is usable, nothing need be given.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraFile {
    path: PathBuf,
    typed: TypedCamera,
    lens: Lens,
}

/// A camera file as typed.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct TypedCamera {
    width: Option<u32>,
    height: Option<u32>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    model: Option<LensModel>,
    #[serde(default)]
    coefficients: Vec<f64>,
    height_m: Option<f64>,
    pitch_rad: Option<f64>,
    roll_rad: Option<f64>,
    forward_axis: Option<[f64; 3]>,
    lever_arm_m: Option<[f64; 3]>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum LensModel {
    Pinhole,
    RadialTangential,
    KannalaBrandt,
}

impl CameraFile {
    /// Reads and checks a camera file.
    ///
    /// # Errors
    /// [`SourceError::Camera`] naming the key and what to write instead.
    pub fn read(path: &Path) -> Result<Self, SourceError> {
        let text = std::fs::read_to_string(path)
            .map_err(|e| SourceError::camera(path, format!("{e}; give --camera a camera.toml, or `kitti`")))?;
        Self::parse(path, &text)
    }

    /// A file that gives nothing.
    pub(crate) fn nothing(path: &Path) -> Self {
        Self { path: path.to_owned(), typed: TypedCamera::default(), lens: Lens::Pinhole }
    }

    /// Where it was read.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Image size, where given whole.
    pub fn size(&self) -> Option<[u32; 2]> {
        Some([self.typed.width?, self.typed.height?])
    }

    /// Intrinsics, where all four are given.
    pub fn intrinsics(&self) -> Option<Intrinsics> {
        let TypedCamera { fx, fy, cx, cy, .. } = self.typed;
        Some(Intrinsics { fx: fx?, fy: fy?, cx: cx?, cy: cy? })
    }

    /// `from_data_set` with what the file gives in its place.
    pub fn overriding(&self, from_data_set: Intrinsics) -> Intrinsics {
        let TypedCamera { fx, fy, cx, cy, .. } = self.typed;
        Intrinsics {
            fx: fx.unwrap_or(from_data_set.fx),
            fy: fy.unwrap_or(from_data_set.fy),
            cx: cx.unwrap_or(from_data_set.cx),
            cy: cy.unwrap_or(from_data_set.cy),
        }
    }

    /// What the lens does to the images.
    pub fn lens(&self) -> Lens {
        self.lens
    }

    /// The mounting, over that of a preset where there is one; `None` when neither gives the height.
    ///
    /// # Errors
    /// [`SourceError::Camera`] when the file gives a mounting without the height.
    pub fn mounting(&self, preset: Option<Mounting>) -> Result<Option<Mounting>, SourceError> {
        let TypedCamera { height_m, pitch_rad, roll_rad, forward_axis, lever_arm_m, .. } = self.typed;
        let base = match (preset, height_m) {
            (Some(preset), _) => preset,
            (None, Some(_)) => LEVEL,
            (None, None) if pitch_rad.or(roll_rad).is_none() && forward_axis.or(lever_arm_m).is_none() => {
                return Ok(None);
            }
            (None, None) => {
                let reason = "a mounting is given without height_m; add the camera's height over the road in metres";
                return Err(SourceError::camera(&self.path, reason));
            }
        };
        Ok(Some(Mounting {
            height_m: height_m.unwrap_or(base.height_m),
            pitch_rad: pitch_rad.unwrap_or(base.pitch_rad),
            roll_rad: roll_rad.unwrap_or(base.roll_rad),
            forward_axis: forward_axis.unwrap_or(base.forward_axis),
            lever_arm_m: lever_arm_m.unwrap_or(base.lever_arm_m),
        }))
    }

    /// Camera and mounting where no data set stands behind the file.
    ///
    /// # Errors
    /// [`SourceError::Camera`] when the file leaves something open.
    pub fn complete(&self) -> Result<(Pinhole, Option<Mounting>), SourceError> {
        let (Some(size), Some(intrinsics)) = (self.size(), self.intrinsics()) else {
            let reason = "a live camera needs width, height, fx, fy, cx and cy; add what is missing";
            return Err(SourceError::camera(&self.path, reason));
        };
        if self.lens != Lens::Pinhole {
            let reason = "a live camera has to publish rectified images, as `kilogs-camera folder` does; rectify them \
                          there, and write model = \"pinhole\" with the intrinsics of the rectified images";
            return Err(SourceError::camera(&self.path, reason));
        }
        let camera = pinhole(size, intrinsics).map_err(|reason| SourceError::camera(&self.path, reason))?;
        Ok((camera, self.mounting(None)?))
    }

    fn parse(path: &Path, text: &str) -> Result<Self, SourceError> {
        let typed: TypedCamera =
            toml::from_str(text).map_err(|e| SourceError::camera(path, e.to_string().trim_end().to_owned()))?;
        typed.check().map_err(|reason| SourceError::camera(path, reason))?;
        let lens = typed.lens().map_err(|reason| SourceError::camera(path, reason))?;
        let forward_axis = typed.forward_axis.map(|[x, y, z]| {
            let length = (x * x + y * y + z * z).sqrt();
            [x / length, y / length, z / length]
        });
        Ok(Self { path: path.to_owned(), typed: TypedCamera { forward_axis, ..typed }, lens })
    }
}

/// A camera, if the calibration can belong to an image of this size.
pub(crate) fn pinhole(size: [u32; 2], intrinsics: Intrinsics) -> Result<Pinhole, String> {
    let ([width, height], Intrinsics { fx, fy, cx, cy }) = (size, intrinsics);
    if !((0.0..=f64::from(width)).contains(&cx) && (0.0..=f64::from(height)).contains(&cy)) {
        return Err(format!(
            "the principal point ({cx}, {cy}) px lies outside the image of {width}x{height} px; \
             is the calibration of another image size?"
        ));
    }
    Ok(Pinhole { width, height, fx, fy, cx, cy })
}

impl TypedCamera {
    fn lens(&self) -> Result<Lens, String> {
        if let Some(number) = self.coefficients.iter().find(|number| !number.is_finite()) {
            return Err(format!("coefficient {number} is not a finite number"));
        }
        let n = self.coefficients.len();
        match (self.model, self.coefficients.as_slice()) {
            (None | Some(LensModel::Pinhole), given) if given.iter().all(|&k| k == 0.0) => Ok(Lens::Pinhole),
            (None | Some(LensModel::Pinhole), _) => Err("a pinhole has no coefficients; leave them out, or write \
                 model = \"radial_tangential\" or \"kannala_brandt\""
                .to_owned()),
            (Some(LensModel::RadialTangential), &[k1, k2, p1, p2]) => Ok(Lens::RadialTangential([k1, k2, p1, p2, 0.0])),
            (Some(LensModel::RadialTangential), &[k1, k2, p1, p2, k3]) => {
                Ok(Lens::RadialTangential([k1, k2, p1, p2, k3]))
            }
            (Some(LensModel::RadialTangential), _) => {
                Err(format!("radial_tangential has coefficients [k1, k2, p1, p2] or [k1, k2, p1, p2, k3], not {n}"))
            }
            (Some(LensModel::KannalaBrandt), &[k1, k2, k3, k4]) => Ok(Lens::KannalaBrandt([k1, k2, k3, k4])),
            (Some(LensModel::KannalaBrandt), _) => {
                Err(format!("kannala_brandt has coefficients [k1, k2, k3, k4], not {n}"))
            }
        }
    }

    fn check(&self) -> Result<(), String> {
        if self.width.or(self.height).is_some() && self.width.and(self.height).is_none() {
            return Err("width and height belong together; give both or neither".to_owned());
        }
        for (key, number) in [("width", self.width), ("height", self.height)] {
            if number == Some(0) {
                return Err(format!("{key} = 0 is not above 0"));
            }
        }
        for (key, number) in [("fx", self.fx), ("fy", self.fy), ("height_m", self.height_m)] {
            if let Some(number) = number.filter(|number| !(number.is_finite() && *number > 0.0)) {
                return Err(format!("{key} = {number} is not a number above 0"));
            }
        }
        let axes = self.forward_axis.into_iter().chain(self.lever_arm_m).flatten();
        let angles = [self.cx, self.cy, self.pitch_rad, self.roll_rad].into_iter().flatten();
        if let Some(number) = angles.chain(axes).find(|number| !number.is_finite()) {
            return Err(format!("{number} is not a finite number"));
        }
        if self.forward_axis.is_some_and(|axis| axis.iter().all(|&component| component == 0.0)) {
            return Err("forward_axis has no direction; [0, 0, 1] looks ahead".to_owned());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const COMPLETE: &str = "width = 100\nheight = 60\nfx = 80\nfy = 81.5\ncx = 50\ncy = 30\n";

    fn parse(text: &str) -> Result<CameraFile, SourceError> {
        CameraFile::parse(Path::new("camera.toml"), text)
    }

    #[test]
    fn a_complete_file_needs_no_data_set() {
        let (camera, mounting) = parse(COMPLETE).and_then(|file| file.complete()).expect("a camera");
        assert_eq!(camera, Pinhole { width: 100, height: 60, fx: 80.0, fy: 81.5, cx: 50.0, cy: 30.0 });
        assert_eq!(mounting, None);
        let missing = parse("fx = 80\n").and_then(|file| file.complete());
        assert!(missing.is_err_and(|e| e.to_string().contains("add what is missing")));
    }

    #[test]
    fn what_is_given_overrides_and_the_rest_stays() {
        let from_data_set = Intrinsics { fx: 1.0, fy: 2.0, cx: 3.0, cy: 4.0 };
        let file = parse("fx = 80\nheight_m = 1.2\nforward_axis = [0, 0, 2]\n").expect("a file");
        assert_eq!(file.overriding(from_data_set), Intrinsics { fx: 80.0, ..from_data_set });
        assert_eq!(file.mounting(None).ok().flatten(), Some(Mounting { height_m: 1.2, ..LEVEL }));
        let tilted = parse("pitch_rad = 0.1\n").expect("a file").mounting(Some(KITTI_MOUNTING));
        assert_eq!(tilted.ok().flatten(), Some(Mounting { pitch_rad: 0.1, ..KITTI_MOUNTING }));
    }

    #[test]
    fn each_bad_key_is_named() {
        let check = |text: &str, expected: &str| {
            let error = parse(text).expect_err("a bad file").to_string();
            assert!(error.contains(expected), "{error}");
        };
        check("focal = 3\n", "unknown field `focal`");
        check("fx = \"wide\"\n", "invalid type");
        check("fx = nan\n", "fx = NaN is not a number above 0");
        check("fy = -1\n", "fy = -1 is not a number above 0");
        check("cx = inf\n", "inf is not a finite number");
        check("width = 100\n", "width and height belong together");
        check("width = 0\nheight = 3\n", "width = 0");
        check("height_m = 0\n", "height_m = 0 is not a number above 0");
        check("forward_axis = [0, 0, 0]\n", "forward_axis has no direction");
        check("forward_axis = [0, 1]\n", "invalid length");
        check("model = \"kannala_brandt\"\n", "[k1, k2, k3, k4], not 0");
        check("model = \"kannala_brandt\"\ncoefficients = [1, 2, 3, 4, 5]\n", "[k1, k2, k3, k4], not 5");
        check("model = \"radial_tangential\"\ncoefficients = [1, 2, 3]\n", "[k1, k2, p1, p2, k3], not 3");
        check("model = \"radial_tangential\"\ncoefficients = [1, 2, nan, 4]\n", "coefficient NaN is not a finite");
        check("model = \"pinhole\"\ncoefficients = [0.1]\n", "a pinhole has no coefficients");
        check("model = \"fisheye\"\n", "unknown variant `fisheye`");
        check("coefficients = [0.1]\n", "write model = \"radial_tangential\"");
        let without_height = parse("pitch_rad = 0.1\n").expect("a file").mounting(None);
        assert!(without_height.is_err_and(|e| e.to_string().contains("without height_m")));
    }

    #[test]
    fn a_lens_is_taken_from_recordings_but_not_from_live_cameras() {
        let file = |lens: &str| parse(&[COMPLETE, lens].concat()).expect("a file");
        let brown = file("model = \"radial_tangential\"\ncoefficients = [0.1, 0.2, 0.3, 0.4]\n");
        assert_eq!(brown.lens(), Lens::RadialTangential([0.1, 0.2, 0.3, 0.4, 0.0]));
        let with_k3 = file("model = \"radial_tangential\"\ncoefficients = [0.1, 0.2, 0.3, 0.4, 0.5]\n");
        assert_eq!(with_k3.lens(), Lens::RadialTangential([0.1, 0.2, 0.3, 0.4, 0.5]));
        let fisheye = file("model = \"kannala_brandt\"\ncoefficients = [0.1, 0.2, 0.3, 0.4]\n");
        assert_eq!(fisheye.lens(), Lens::KannalaBrandt([0.1, 0.2, 0.3, 0.4]));
        assert_eq!(file("model = \"pinhole\"\ncoefficients = [0, 0]\n").lens(), Lens::Pinhole);
        assert!(brown.complete().is_err_and(|e| e.to_string().contains("publish rectified images")));
    }

    #[test]
    fn a_calibration_of_another_size_is_noticed() {
        let intrinsics = Intrinsics { fx: 700.0, fy: 700.0, cx: 607.0, cy: 185.0 };
        assert!(pinhole([1241, 376], intrinsics).is_ok());
        assert!(pinhole([416, 128], intrinsics).is_err_and(|e| e.contains("another image size")));
    }
}
