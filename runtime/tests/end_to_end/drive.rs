//! Short recordings of the simulated street, and what a run makes of them.

use crate::program::{kilogs_succeeds, word};
use std::collections::BTreeMap;
use std::f64::consts::FRAC_PI_2;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Size of the images, px.
pub const SIZE: [u32; 2] = [416, 128];

/// A recording in KITTI's layout, with its truth.
pub struct Drive {
    folder: TempDir,
}

impl Drive {
    /// Simulates a drive.
    pub fn new(length_m: f64) -> Self {
        Self::simulated(&["--length", &length_m.to_string()])
    }

    /// Simulates a drive to the right around a square block of `side_m` with round corners, `length_m` long; `step_m` from
    /// frame to frame.
    pub fn around_a_block(side_m: f64, length_m: f64, step_m: f64) -> Self {
        let poses = tempfile::NamedTempFile::new().expect("a file");
        let n_frames = (length_m / step_m) as usize;
        let lines = (0..n_frames).map(|frame| line_of_block(side_m, frame as f64 * step_m));
        std::fs::write(poses.path(), lines.collect::<String>()).expect("written");
        Self::simulated(&["--path", &word(poses.path())])
    }

    fn simulated(what: &[&str]) -> Self {
        let drive = Self { folder: tempfile::tempdir().expect("a folder") };
        let [width, height] = SIZE.map(|side| side.to_string());
        let folder = word(drive.path());
        let size = ["--width", &width, "--height", &height, "--quiet", "--write", &folder];
        kilogs_succeeds(["camera", "sim"].iter().chain(what).chain(&size));
        drive
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        self.folder.path()
    }

    /// A file of it.
    pub fn file(&self, name: &str) -> PathBuf {
        self.path().join(name)
    }

    /// An image of it.
    pub fn image(&self, index: usize) -> PathBuf {
        self.file(&format!("images/{index:06}.png"))
    }

    /// The same drive elsewhere, without its truth.
    pub fn copy(&self) -> Self {
        let copy = Self { folder: tempfile::tempdir().expect("a folder") };
        for (name, bytes) in files(self.path()) {
            if name.starts_with("poses.txt") || name.starts_with("depth") {
                continue;
            }
            write(&copy.path().join(name), bytes);
        }
        copy
    }

    /// Images of it.
    pub fn n_images(&self) -> usize {
        std::fs::read_dir(self.file("images")).expect("images").count()
    }

    /// A camera.toml that says everything, for a live camera.
    pub fn complete_camera_file(&self) -> PathBuf {
        let calibration = std::fs::read_to_string(self.file("calib.txt")).expect("a calibration");
        let row: Vec<f64> = calibration.split_whitespace().skip(1).map_while(|n| n.parse().ok()).collect();
        let [width, height] = SIZE;
        let (fx, fy, cx, cy) = (row[0], row[5], row[2] + 0.5, row[6] + 0.5);
        let path = self.file("live_camera.toml");
        let text = format!(
            "width = {width}\nheight = {height}\nfx = {fx:?}\nfy = {fy:?}\ncx = {cx:?}\ncy = {cy:?}\nheight_m = 1.65\n"
        );
        write(&path, text.into_bytes());
        path
    }
}

/// Radius of a block's corners, m.
const CORNER_M: f64 = 10.0;

/// KITTI pose of the place `along_m` from the middle of one side of a block.
fn line_of_block(side_m: f64, along_m: f64) -> String {
    let (straight_m, corner_m) = (side_m - 2.0 * CORNER_M, CORNER_M * FRAC_PI_2);
    let (mut x, mut z, mut heading_rad) = (0.0, -0.5 * straight_m, 0.0_f64);
    let mut left_m = along_m + 0.5 * straight_m;
    loop {
        let (sin, cos) = heading_rad.sin_cos();
        let driven_m = left_m.min(straight_m);
        (x, z) = (x + driven_m * sin, z + driven_m * cos);
        left_m -= driven_m;
        let turned_rad = left_m.min(corner_m) / CORNER_M;
        let (middle_x, middle_z) = (x + CORNER_M * cos, z - CORNER_M * sin);
        heading_rad += turned_rad;
        (x, z) = (middle_x - CORNER_M * heading_rad.cos(), middle_z + CORNER_M * heading_rad.sin());
        left_m -= CORNER_M * turned_rad;
        if left_m <= 0.0 {
            break;
        }
    }
    let (sin, cos) = heading_rad.sin_cos();
    format!("{cos} 0 {sin} {x} 0 1 0 0 {} 0 {cos} {z}\n", -sin)
}

/// Every file below `folder` with its content, by its path in there.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(dir) = open.pop() {
        for entry in std::fs::read_dir(&dir).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("it lies inside").to_owned();
                found.insert(name, std::fs::read(&path).expect("a file"));
            }
        }
    }
    found
}

/// Writes a file, with the folders that it needs.
pub fn write(path: &Path, bytes: impl AsRef<[u8]>) {
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    std::fs::write(path, bytes).expect("a file");
}
