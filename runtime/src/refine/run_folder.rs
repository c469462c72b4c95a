//! The run that a map belongs to: its figures follow the map.

use super::summary::Scores;
use crate::map_store::MapStoreReader;
use crate::output::report::{Mapping, Report};
use crate::output::{OutputError, RenderedKeyframe, Renders, VIEWS_CSV, rewrite_html};
use std::path::{Path, PathBuf};

/// An output folder whose map is refined in place.
///
/// `report.json`, `report.html`, `renders/` and `views.csv` speak of the stored map, so they are written anew; `eval.json` repeats
/// them and goes.
#[derive(Debug, PartialEq)]
pub(super) struct RunFolder {
    folder: PathBuf,
    report: Report,
}

impl RunFolder {
    /// The folder around `map`, where a run with a report left it.
    pub(super) fn of(map: &Path) -> Option<Self> {
        let folder = map.parent().filter(|_| map.file_name().is_some_and(|name| name == "map"))?.to_owned();
        let path = folder.join("report.json");
        let text = std::fs::read_to_string(&path).ok()?;
        match serde_json::from_str(&text) {
            Ok(report) => Some(Self { folder, report }),
            Err(problem) => {
                log::warn!("{} is left as it is and will not know of the refinement: {problem}", path.display());
                None
            }
        }
    }

    /// Where its table of views is.
    pub(super) fn views_csv(&self) -> PathBuf {
        self.folder.join(VIEWS_CSV)
    }

    /// Where pictures of its map go.
    pub(super) fn renders(&self, map: &MapStoreReader) -> Renders {
        Renders::new(&self.folder, map.keyframes().len())
    }

    /// Writes the report with what the map is now, and how it looks.
    ///
    /// # Errors
    /// [`OutputError`].
    pub(super) fn update(
        mut self,
        map: &MapStoreReader,
        scores: &Scores,
        pictures: &[RenderedKeyframe],
    ) -> Result<(), OutputError> {
        self.report.mapping = Mapping {
            anchors_total: map.pages().iter().map(|page| u64::from(page.n_anchors)).sum(),
            gaussians: scores.gaussians,
            map_bytes: scores.map_bytes,
            store_bytes: scores.store_bytes,
            psnr_train_db: scores.psnr_train_db,
            ssim_train: scores.ssim_train,
            psnr_heldout_db: scores.psnr_heldout_db,
            ssim_heldout: scores.ssim_heldout,
            psnr_worst_100m_db: scores.psnr_worst_100m_db,
            ..self.report.mapping
        };
        self.report.write(&self.folder)?;
        rewrite_html(&self.folder, &self.report, pictures)?;
        let judged = self.folder.join("eval.json");
        if judged.is_file() {
            std::fs::remove_file(&judged).map_err(OutputError::write(&judged))?;
            log::info!("{} was of the map before; run kilogs eval again", judged.display());
        }
        Ok(())
    }
}
