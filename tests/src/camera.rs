//! Recordings of a few tiny images, and camera processes that are the test program itself.

use std::path::Path;

use image::{DynamicImage, GrayImage, Luma, Rgb, RgbImage};
use tempfile::TempDir;

/// Width and height of the tiny images, px.
pub const SIZE: [u32; 2] = [48, 32];

/// Separates the arguments of a camera process within the one argument that the test harness lets through.
const SEPARATOR: char = '\u{1f}';
const ARGUMENTS_PREFIX: &str = "camera-arguments=";

/// Grey value of pixel (x, y) of frame `index`.
pub fn grey_value(index: u64, x: u32, y: u32) -> u8 {
    (index as u32 * 31 + x * 3 + y * 5) as u8
}

/// Writes a grey recording of `n_frames` at 10 Hz with `calib.txt` and `times.txt`.
pub fn grey_recording(n_frames: u64) -> TempDir {
    recording(n_frames, |index| GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| Luma([grey_value(index, x, y)])).into())
}

/// Writes a color recording like [`grey_recording`]; green and blue differ from red by 1 and 2.
pub fn color_recording(n_frames: u64) -> TempDir {
    let color = |index, x, y| Rgb([0, 1, 2].map(|channel| grey_value(index, x, y).wrapping_add(channel)));
    recording(n_frames, |index| RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| color(index, x, y)).into())
}

/// Arguments that make the own test program run the ignored test `acts_as_camera` with these camera arguments.
pub fn camera_process_arguments(camera_arguments: &[&str]) -> Vec<String> {
    let joined = camera_arguments.join(&SEPARATOR.to_string());
    let harness = ["acts_as_camera", "--exact", "--ignored", "--nocapture"].map(str::to_owned);
    harness.into_iter().chain([format!("{ARGUMENTS_PREFIX}{joined}")]).collect()
}

/// The camera arguments that [`camera_process_arguments`] handed over, `None` where nobody did.
pub fn handed_over_arguments() -> Option<Vec<String>> {
    let argument = std::env::args().find_map(|argument| argument.strip_prefix(ARGUMENTS_PREFIX).map(str::to_owned))?;
    Some(argument.split(SEPARATOR).map(str::to_owned).collect())
}

fn recording(n_frames: u64, image_of: impl Fn(u64) -> DynamicImage) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let write = |path: &Path, text: String| std::fs::write(path, text).expect("a temporary file");
    std::fs::create_dir(folder.path().join("images")).expect("a temporary folder");
    for index in 0..n_frames {
        image_of(index).save(folder.path().join(format!("images/{index:06}.png"))).expect("a temporary image");
    }
    let [cx, cy] = SIZE.map(|length| f64::from(length) / 2.0 - 0.5);
    write(&folder.path().join("calib.txt"), format!("P0: 40 0 {cx} 0 0 40 {cy} 0 0 0 1 0\n"));
    let times = (0..n_frames).map(|index| format!("{:.6}\n", index as f64 / 10.0)).collect();
    write(&folder.path().join("times.txt"), times);
    folder
}
