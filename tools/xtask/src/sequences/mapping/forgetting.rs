//! What the first chunk of a map looks like when it was finished, and after the rest of the drive.

use crate::sequences::bench::read_text;
use crate::step::StepFailed;
use std::path::Path;

/// Keyframes of a chunk, and how many more it takes until none of them is trained in the window of the newest.
const FINISHED_AT_KEYFRAME: u32 = 100 + 6;

/// A row of `views.csv`.
struct View {
    frame: u64,
    keyframe: u32,
    chunk: u32,
    is_held_out: bool,
    psnr_db: f64,
}

/// What the views of a map score.
pub(super) struct Views {
    views: Vec<View>,
}

impl Views {
    /// Reads `views.csv` of a folder.
    pub fn read(folder: &Path) -> Result<Self, StepFailed> {
        let path = folder.join("views.csv");
        let text = read_text(&path)?;
        let views: Option<Vec<View>> = text.lines().skip(1).map(view_of).collect();
        views
            .map(|views| Self { views })
            .ok_or_else(|| StepFailed::Broken(format!("reading {}: not a table of views", path.display())))
    }

    /// Frames of the drive after which its first chunk was finished; `None` when it never was.
    pub fn frames_until_finished(&self) -> Option<u64> {
        let later = self.views.iter().filter(|view| !view.is_held_out && view.keyframe > FINISHED_AT_KEYFRAME);
        later.map(|view| view.frame).min()
    }

    /// Mean PSNR of the first chunk's keyframes and of its held-out views, dB, as a cell.
    pub fn first_chunk(&self) -> String {
        let mean = |is_held_out: bool| {
            let of_kind = self.views.iter().filter(|view| view.chunk == 0 && view.is_held_out == is_held_out);
            let (sum, n) = of_kind.fold((0.0, 0), |(sum, n), view| (sum + view.psnr_db, n + 1));
            if n == 0 { "-".to_owned() } else { format!("{:.2}", sum / f64::from(n)) }
        };
        format!("{} / {}", mean(false), mean(true))
    }
}

fn view_of(line: &str) -> Option<View> {
    let mut cells = line.split(',');
    let (frame, keyframe, chunk) = (cells.next()?, cells.next()?, cells.next()?);
    let (held_out, psnr_db) = (cells.next()?, cells.nth(1)?);
    Some(View {
        frame: frame.parse().ok()?,
        keyframe: keyframe.parse().ok()?,
        chunk: chunk.parse().ok()?,
        is_held_out: held_out == "1",
        psnr_db: psnr_db.parse().ok()?,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn views(rows: &str) -> Result<Views, StepFailed> {
        let dir = tempfile::tempdir().expect("a folder");
        let text = format!("frame,keyframe,chunk,held_out,driven_m,psnr_db,ssim\n{rows}");
        std::fs::write(dir.path().join("views.csv"), text).expect("written");
        Views::read(dir.path())
    }

    #[test]
    fn the_first_chunk_is_finished_when_the_window_has_left_it() {
        let check = |rows: &str, frames: Option<u64>, cell: &str| {
            let views = views(rows).expect("a table");
            assert_eq!((views.frames_until_finished(), views.first_chunk().as_str()), (frames, cell), "{rows}");
        };
        check("", None, "- / -");
        check("0,0,0,0,0.0,20,0.5\n3,1,0,0,1.0,21,0.5\n7,1,0,1,1.0,18,0.5\n", None, "20.50 / 18.00");
        check("0,0,0,0,0.0,20,0.5\n300,106,1,0,80.0,9,0.5\n", None, "20.00 / -");
        check("0,0,0,0,0.0,20,0.5\n302,107,1,1,80.0,9,0.5\n304,107,1,0,80.0,9,0.5\n", Some(304), "20.00 / -");
    }

    #[test]
    fn another_table_is_refused() {
        assert!(views("0,0,0,0\n").is_err());
    }
}
