//! Short recordings of the simulated street, and what a run makes of them.

use crate::program::{kilogs_succeeds, word};
use std::collections::BTreeMap;
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
        let drive = Self { folder: tempfile::tempdir().expect("a folder") };
        let [width, height] = SIZE.map(|side| side.to_string());
        let length = length_m.to_string();
        let folder = word(drive.path());
        let size = ["--length", &length, "--width", &width, "--height", &height, "--quiet"];
        kilogs_succeeds(["camera", "sim", "--write", &folder].iter().chain(&size));
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
