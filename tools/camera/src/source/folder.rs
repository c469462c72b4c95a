//! Recorded folders in the layout of KITTI odometry. `poses.txt` is never opened here.

use std::path::{Path, PathBuf};

use kilogs_core::conventions::TimestampNs;

use super::image_file::{ImageKind, ImageReader};
use super::{Distortion, FrameInfo, IndexedFrames, SourceError, SourceFormat, calibration, times};
use crate::camera_file::{CAMERA_FILE_NAME, CameraArgument, CameraFile, Intrinsics, KITTI_MOUNTING, pinhole};

/// Image folders in the order in which they are looked for, with the calibration rows that may describe them.
const LAYOUTS: [(&str, &[&str]); 3] = [("image_0", &["P0"]), ("image_2", &["P2"]), ("images", &["P0", "P2"])];

const IMAGE_EXTENSIONS: [&str; 3] = ["png", "jpg", "jpeg"];

/// What is known about a data set before its first frame is played.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraDescription {
    /// Size, intrinsics, mounting, pixel format and number of frames.
    pub format: SourceFormat,
    /// What the images on disk have to be rid of to be those of the format's camera.
    pub distortion: Option<Distortion>,
    /// The image of each frame.
    pub images: Vec<PathBuf>,
    /// Time of each frame.
    pub timestamps_ns: Vec<TimestampNs>,
}

/// Looks at a data set as [`FolderSource::open`] does, and says what it found.
///
/// # Errors
/// [`SourceError`] as [`FolderSource::open`].
pub fn describe(dataset: &Path, camera: Option<&str>, fps: Option<f64>) -> Result<CameraDescription, SourceError> {
    let source = FolderSource::open(dataset, camera.map(CameraArgument::from).as_ref(), fps)?;
    let format = source.format();
    let images = source.file_names.iter().map(|name| source.folder.join(&**name)).collect();
    Ok(CameraDescription { format, distortion: source.distortion, images, timestamps_ns: source.timestamps_ns })
}

/// Reads the images of a folder.
pub struct FolderSource {
    folder: PathBuf,
    file_names: Vec<Box<str>>,
    timestamps_ns: Vec<TimestampNs>,
    format: SourceFormat,
    distortion: Option<Distortion>,
    reader: ImageReader,
    path: PathBuf,
}

impl FolderSource {
    /// Finds images, calibration and times of a data set. The data set is its root, or one of its image folders.
    ///
    /// # Errors
    /// [`SourceError`] when one of them is missing or cannot be believed.
    pub fn open(dataset: &Path, camera: Option<&CameraArgument>, fps: Option<f64>) -> Result<Self, SourceError> {
        let layout = find_layout(dataset)?;
        let file_names = list_images(&layout.folder)?;
        let numbers: Vec<Option<u64>> = file_names.iter().map(|name| image_number(name)).collect();
        let times_path = layout.root.join("times.txt");
        let timestamps_ns = match fps {
            Some(fps) => times::times_at_rate(fps, file_names.len())?,
            None => times::assign_times(&times_path, times::read_times(&times_path)?, &numbers)?,
        };
        let mut reader = ImageReader::default();
        let kind = first_readable(&mut reader, &layout.folder, &file_names)?;
        let (format, distortion) = read_format(&layout, camera, kind).map_err(|error| of_data_set(error, camera))?;
        let format = SourceFormat { n_frames: Some(file_names.len() as u64), ..format };
        reader.rectify(distortion);
        let path = layout.folder.join("image");
        Ok(Self { folder: layout.folder, file_names, timestamps_ns, format, distortion, reader, path })
    }
}

impl IndexedFrames for FolderSource {
    fn format(&self) -> SourceFormat {
        self.format
    }

    fn n_frames(&self) -> u64 {
        self.file_names.len() as u64
    }

    fn info(&self, index: u64) -> FrameInfo {
        FrameInfo { timestamp_ns: self.timestamps_ns[index as usize], exposure_us: 0 }
    }

    fn read_frame(&mut self, index: u64, pixels: &mut [u8]) -> Result<(), SourceError> {
        self.path.set_file_name(&*self.file_names[index as usize]);
        let camera = &self.format.camera;
        let expected = ImageKind { size: [camera.width, camera.height], pixel_format: self.format.pixel_format };
        self.reader
            .decode(&self.path, expected, pixels)
            .map_err(|reason| SourceError::file(&self.path, format!("{reason}; the frame is left out")))
    }
}

/// A file of the data set that cannot be used is bad input; only the one given with `--camera` is a matter of usage.
fn of_data_set(error: SourceError, given: Option<&CameraArgument>) -> SourceError {
    match error {
        SourceError::Camera { path, reason } if given != Some(&CameraArgument::File(path.clone())) => {
            SourceError::File { path, reason }
        }
        other => other,
    }
}

struct Layout {
    root: PathBuf,
    folder: PathBuf,
    rows: &'static [&'static str],
}

fn find_layout(dataset: &Path) -> Result<Layout, SourceError> {
    if !dataset.is_dir() {
        return Err(SourceError::file(dataset, "there is no such folder; give the folder of a recording"));
    }
    if let Some((name, rows)) = LAYOUTS.iter().find(|(name, _)| dataset.join(name).is_dir()) {
        return Ok(Layout { root: dataset.to_owned(), folder: dataset.join(name), rows });
    }
    let own_name = dataset.file_name().and_then(|name| name.to_str());
    match (LAYOUTS.iter().find(|(name, _)| own_name == Some(name)), dataset.parent()) {
        (Some((_, rows)), Some(root)) => Ok(Layout { root: root.to_owned(), folder: dataset.to_owned(), rows }),
        _ => {
            let reason = "the folder has no image_0, image_2 or images; give the folder that holds one of them";
            Err(SourceError::file(dataset, reason))
        }
    }
}

fn list_images(folder: &Path) -> Result<Vec<Box<str>>, SourceError> {
    let unreadable = |e: std::io::Error| SourceError::file(folder, e.to_string());
    let mut names: Vec<Box<str>> = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let name = entry.map_err(unreadable)?.file_name();
        let extension = Path::new(&name).extension().map(|extension| extension.to_ascii_lowercase());
        let is_image = extension.is_some_and(|extension| IMAGE_EXTENSIONS.iter().any(|known| extension == *known));
        match name.to_str() {
            Some(name) if is_image && !name.starts_with('.') => names.push(name.into()),
            _ => (),
        }
    }
    if names.is_empty() {
        return Err(SourceError::file(folder, "the folder has no .png or .jpg images"));
    }
    names.sort_unstable_by(|a, b| image_number(a).cmp(&image_number(b)).then(a.cmp(b)));
    let same_number = |pair: &&[Box<str>]| image_number(&pair[0]).is_some_and(|n| image_number(&pair[1]) == Some(n));
    match names.windows(2).find(same_number) {
        Some(pair) => {
            let reason = format!("{} and {} are the same frame; remove one of them", pair[0], pair[1]);
            Err(SourceError::file(folder, reason))
        }
        None => Ok(names),
    }
}

fn image_number(name: &str) -> Option<u64> {
    Path::new(name).file_stem()?.to_str()?.parse().ok()
}

/// Size and color of the recording: those of the first image whose header can be read.
fn first_readable(reader: &mut ImageReader, folder: &Path, names: &[Box<str>]) -> Result<ImageKind, SourceError> {
    let mut first_problem = None;
    for name in names {
        let path = folder.join(&**name);
        match reader.probe(&path) {
            Ok(kind) => return Ok(kind),
            Err(reason) => {
                first_problem
                    .get_or_insert_with(|| SourceError::file(&path, format!("{reason}; no image can be read")));
            }
        }
    }
    Err(first_problem.unwrap_or_else(|| SourceError::file(folder, "the folder has no images")))
}

fn read_format(
    layout: &Layout,
    camera: Option<&CameraArgument>,
    kind: ImageKind,
) -> Result<(SourceFormat, Option<Distortion>), SourceError> {
    let calib_path = layout.root.join("calib.txt");
    let beside = [&layout.root, &layout.folder].map(|folder| folder.join(CAMERA_FILE_NAME));
    let beside = beside.iter().find(|path| path.is_file());
    let (file, preset) = match (camera, beside) {
        (Some(CameraArgument::File(path)), _) => (CameraFile::read(path)?, None),
        (argument, beside) => {
            let file = beside.map_or_else(|| Ok(CameraFile::nothing(&calib_path)), |path| CameraFile::read(path))?;
            (file, argument.map(|_| KITTI_MOUNTING))
        }
    };
    if let Some([width, height]) = file.size().filter(|&size| size != kind.size) {
        let [image_width, image_height] = kind.size;
        let reason = format!(
            "width and height are {width}x{height}, the images have {image_width}x{image_height} px; \
             correct them, or leave them out"
        );
        return Err(SourceError::camera(file.path(), reason));
    }
    let from_calib = || calibration::read_intrinsics(&calib_path, layout.rows);
    let intrinsics: Intrinsics = match file.intrinsics() {
        Some(complete) => complete,
        None => file.overriding(from_calib()?),
    };
    let seen = pinhole(kind.size, intrinsics).map_err(|reason| SourceError::camera(file.path(), reason))?;
    let (camera, distortion) =
        Distortion::of(file.lens(), seen).map_err(|reason| SourceError::camera(file.path(), reason))?;
    let mounting = file.mounting(preset)?;
    let format = SourceFormat { camera, mounting, pixel_format: kind.pixel_format, n_frames: None };
    Ok((format, distortion))
}
