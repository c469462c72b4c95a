//! Some camera images beside their renders, for people.

use super::JudgedView;
use super::viewer::RenderError;
use image::{GenericImage, RgbImage};
use std::path::{Path, PathBuf};

/// Writes `NNNNNN.png`, camera left and render right, for some of the judged views, evenly along the drive.
#[derive(Debug)]
pub struct RenderSamples {
    folder: PathBuf,
    every: usize,
    n_seen: usize,
    files: Vec<PathBuf>,
}

impl RenderSamples {
    /// At most `n_wanted` of `n_keyframes` mapping keyframes go to `folder`, which is made.
    ///
    /// # Errors
    /// [`RenderError::Write`] when the folder cannot be made.
    pub fn create(folder: &Path, n_keyframes: usize, n_wanted: usize) -> Result<Self, RenderError> {
        std::fs::create_dir_all(folder)
            .map_err(|source| RenderError::Write { path: folder.to_owned(), reason: source.to_string() })?;
        let every = n_keyframes.div_ceil(n_wanted.max(1)).max(1);
        Ok(Self { folder: folder.to_owned(), every, n_seen: 0, files: Vec::with_capacity(n_wanted) })
    }

    /// Writes the view when it is one of those wanted; held-out views are not.
    ///
    /// # Errors
    /// [`RenderError::Write`] when the picture cannot be written.
    pub fn observe(&mut self, view: &JudgedView<'_>) -> Result<(), RenderError> {
        if view.keyframe.is_held_out {
            return Ok(());
        }
        self.n_seen += 1;
        if (self.n_seen - 1) % self.every != self.every / 2 {
            return Ok(());
        }
        let path = self.folder.join(format!("{:06}.png", view.keyframe.frame_index));
        save(&path, &side_by_side(view.camera, &view.render.to_image()))?;
        self.files.push(path);
        Ok(())
    }

    /// The files written, in the order of the drive.
    pub fn files(&self) -> &[PathBuf] {
        &self.files
    }
}

fn side_by_side(left: &RgbImage, right: &RgbImage) -> RgbImage {
    let mut both = RgbImage::new(left.width() + right.width(), left.height().max(right.height()));
    for (picture, x) in [(left, 0), (right, left.width())] {
        // Both fit by construction.
        let _ = both.copy_from(picture, x, 0);
    }
    both
}

pub(super) fn save(path: &Path, picture: &RgbImage) -> Result<(), RenderError> {
    picture.save(path).map_err(|source| RenderError::Write { path: path.to_owned(), reason: source.to_string() })
}
