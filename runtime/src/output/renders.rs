//! `renders/`: the camera's image of some keyframes beside what the map shows from there.

use super::OutputError;
use crate::render_views::JudgedView;
use image::ExtendedColorType;
use image::codecs::jpeg::JpegEncoder;
use kilogs_core::conventions::TimestampNs;
use kilogs_eval::ImageQuality;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

/// Visually lossless at street texture; a pair of 1241 x 376 takes about 400 kB.
const JPEG_QUALITY: u8 = 90;

/// An image as packed bytes: grey, or red, green, blue.
#[derive(Clone, Copy, Debug)]
pub struct Picture<'a> {
    /// Packed rows.
    pub bytes: &'a [u8],
    /// Width, px.
    pub width: u32,
    /// Height, px.
    pub height: u32,
    /// 1 (grey) or 3 (red, green, blue).
    pub channels: usize,
}

/// A keyframe whose pictures are in `renders/`.
#[derive(Clone, Debug, PartialEq)]
pub struct RenderedKeyframe {
    /// Index of the frame in the stream.
    pub frame_index: u64,
    /// Middle of the exposure.
    pub timestamp_ns: TimestampNs,
    /// What the render scores against the camera.
    pub quality: ImageQuality,
    /// File with the camera's image.
    pub camera_file: PathBuf,
    /// File with the render.
    pub render_file: PathBuf,
}

/// Keyframes whose pictures are written.
const N_RENDERS: usize = 12;

/// Pictures of some of a map's keyframes, evenly spread over the drive, while the map is judged.
#[derive(Debug)]
pub struct Renders {
    dir: PathBuf,
    every: usize,
    n_seen: usize,
    written: Vec<RenderedKeyframe>,
}

impl Renders {
    /// Pictures in the output folder `dir`, of a map with so many keyframes.
    pub fn new(dir: &Path, n_keyframes: usize) -> Self {
        let every = n_keyframes.div_ceil(N_RENDERS).max(1);
        Self { dir: dir.to_owned(), every, n_seen: 0, written: Vec::with_capacity(N_RENDERS) }
    }

    /// Writes the pictures of a view if it is one of those that are shown.
    ///
    /// # Errors
    /// [`OutputError`] as [`write_render`].
    pub fn push(&mut self, view: &JudgedView<'_>) -> Result<(), OutputError> {
        let keyframe = view.keyframe;
        if keyframe.is_held_out {
            return Ok(());
        }
        let is_wanted = self.n_seen % self.every == self.every / 2;
        self.n_seen += 1;
        if is_wanted {
            let rendered = view.render.to_image();
            let (width, height) = (view.camera.width(), view.camera.height());
            let [camera, render] =
                [view.camera.as_raw(), rendered.as_raw()].map(|bytes| Picture { bytes, width, height, channels: 3 });
            let (index, timestamp_ns) = (keyframe.frame_index, keyframe.timestamp_ns);
            self.written.push(write_render(&self.dir, index, timestamp_ns, view.quality, camera, render)?);
        }
        Ok(())
    }

    /// The keyframes whose pictures were written.
    pub fn written(self) -> Vec<RenderedKeyframe> {
        self.written
    }
}

/// Writes both pictures of a keyframe as `renders/NNNNNN_camera.jpg` and `renders/NNNNNN_render.jpg`.
///
/// # Errors
/// [`OutputError`] when the disk does not take it or a picture has not the bytes that its size asks for.
pub fn write_render(
    dir: &Path,
    frame_index: u64,
    timestamp_ns: TimestampNs,
    quality: ImageQuality,
    camera: Picture<'_>,
    render: Picture<'_>,
) -> Result<RenderedKeyframe, OutputError> {
    let folder = dir.join("renders");
    std::fs::create_dir_all(&folder).map_err(|source| OutputError::Folder { path: folder.clone(), source })?;
    let camera_file = folder.join(format!("{frame_index:06}_camera.jpg"));
    let render_file = folder.join(format!("{frame_index:06}_render.jpg"));
    for (path, picture) in [(&camera_file, camera), (&render_file, render)] {
        write_jpeg(path, picture).map_err(OutputError::write(path))?;
    }
    Ok(RenderedKeyframe { frame_index, timestamp_ns, quality, camera_file, render_file })
}

fn write_jpeg(path: &Path, picture: Picture<'_>) -> io::Result<()> {
    let color = if picture.channels == 1 { ExtendedColorType::L8 } else { ExtendedColorType::Rgb8 };
    let needed = picture.width as usize * picture.height as usize * usize::from(color.channel_count());
    if picture.bytes.len() != needed || picture.channels != usize::from(color.channel_count()) {
        let (width, height, channels) = (picture.width, picture.height, picture.channels);
        return Err(io::Error::other(format!(
            "picture has {} bytes, {width} x {height} with {channels} channels asks for {needed}",
            picture.bytes.len()
        )));
    }
    let mut writer = BufWriter::new(File::create(path)?);
    JpegEncoder::new_with_quality(&mut writer, JPEG_QUALITY)
        .encode(picture.bytes, picture.width, picture.height, color)
        .map_err(|error| match error {
            image::ImageError::IoError(error) => error,
            other => io::Error::other(other),
        })?;
    writer.flush()
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUALITY: ImageQuality = ImageQuality { psnr_db: 20.0, ssim: 0.5 };

    #[test]
    fn both_pictures_come_back_as_they_were_put_in() {
        let dir = tempfile::tempdir().expect("temporary folder");
        let ramp: Vec<u8> = (0..64 * 32).map(|k| (k % 64 * 4) as u8).collect();
        let camera = Picture { bytes: &ramp, width: 64, height: 32, channels: 1 };
        let colors = [255, 64, 0].repeat(64 * 32);
        let render = Picture { bytes: &colors, width: 64, height: 32, channels: 3 };
        let written = write_render(dir.path(), 42, 7, QUALITY, camera, render).expect("written");
        assert!(written.camera_file.ends_with("renders/000042_camera.jpg"));
        let grey = image::open(&written.camera_file).expect("a picture").into_luma8();
        assert!(grey.as_raw().iter().zip(&ramp).all(|(a, b)| a.abs_diff(*b) < 12));
        let color = image::open(&written.render_file).expect("a picture").into_rgb8();
        assert!(color.pixels().all(|p| p.0.iter().zip([255, 64, 0]).all(|(a, b)| a.abs_diff(b) < 6)));
    }

    #[test]
    fn a_picture_of_another_size_is_refused() {
        let dir = tempfile::tempdir().expect("temporary folder");
        let picture = Picture { bytes: &[0; 10], width: 4, height: 3, channels: 1 };
        let complaint = write_render(dir.path(), 1, 1, QUALITY, picture, picture).expect_err("too short").to_string();
        assert!(complaint.contains("picture has 10 bytes, 4 x 3 with 1 channels asks for 12"), "{complaint}");
    }
}
