//! `views.csv`: what each stored view scores, in the order of the drive.

use super::OutputError;
use super::number::Measured;
use super::sink::TextSink;
use crate::render_views::JudgedView;
use std::path::Path;

/// Name of the table in an output folder.
pub const VIEWS_CSV: &str = "views.csv";

/// A table of judged views.
#[derive(Debug)]
pub struct ViewTable {
    csv: TextSink,
}

impl ViewTable {
    /// Makes the file, replacing one that is there.
    ///
    /// # Errors
    /// [`OutputError`].
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let mut csv = TextSink::create(path.to_owned())?;
        csv.write(format_args!("frame,keyframe,chunk,held_out,driven_m,psnr_db,ssim\n"))?;
        Ok(Self { csv })
    }

    /// Appends a view.
    ///
    /// # Errors
    /// [`OutputError`].
    pub fn push(&mut self, view: &JudgedView<'_>) -> Result<(), OutputError> {
        let (keyframe, quality) = (view.keyframe, view.quality);
        self.csv.write(format_args!(
            "{},{},{},{},{},{},{}\n",
            keyframe.frame_index,
            keyframe.keyframe_id,
            keyframe.chunk_id,
            u8::from(keyframe.is_held_out),
            Measured(view.driven_m as f32),
            Measured(quality.psnr_db as f32),
            Measured(quality.ssim as f32),
        ))
    }

    /// Hands everything to the system.
    ///
    /// # Errors
    /// [`OutputError`].
    pub fn finish(self) -> Result<(), OutputError> {
        self.csv.finish()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render_views::Picture;
    use kilogs_core::store::StoredKeyframe;
    use kilogs_eval::ImageQuality;

    #[test]
    fn a_row_says_where_a_view_is_and_what_it_scores() {
        let dir = tempfile::tempdir().expect("temporary folder");
        let mut table = ViewTable::create(&dir.path().join(VIEWS_CSV)).expect("created");
        let keyframe = StoredKeyframe {
            keyframe_id: 217,
            chunk_id: 2,
            frame_index: 570,
            timestamp_ns: 5,
            rotation_xyzw: [0.0, 0.0, 0.0, 1.0],
            translation_m: [0.0; 3],
            scale: 1.0,
            is_held_out: true,
            image_bytes: 1,
            image_crc: 0,
        };
        let quality = ImageQuality { psnr_db: 21.25, ssim: 0.5 };
        let (render, camera) = (Picture::new(1, 1), image::RgbImage::new(1, 1));
        let view = JudgedView { keyframe: &keyframe, driven_m: 430.5, quality, render: &render, camera: &camera };
        table.push(&view).expect("written");
        table.finish().expect("on disk");
        let text = std::fs::read_to_string(dir.path().join(VIEWS_CSV)).expect("read");
        let expected = "frame,keyframe,chunk,held_out,driven_m,psnr_db,ssim\n570,217,2,1,430.500,21.250,0.500\n";
        assert_eq!(text, expected);
    }
}
