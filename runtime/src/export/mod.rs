//! `kilogs export`: a stored map as a file that other programs open.

mod decode;
mod ply;

use crate::map_store::{MapStoreReader, StoreError};
use decode::{MapGaussian, decode_gaussian};
use indicatif::{ProgressBar, ProgressStyle};
use kilogs_core::map::GaussianParams;
use kilogs_core::store::{PageLabel, StoredKeyframe};
use ply::PlyWriter;
use std::path::{Path, PathBuf};

/// Options of `kilogs export`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Example:\n  kilogs export out/04/map --ply street.ply\n\n\
    The file has the layout of the reference 3D Gaussian splatting; SuperSplat, antimatter15/splat and others open it.")]
#[command(group(clap::ArgGroup::new("format").required(true).multiple(false)))]
pub struct ExportArgs {
    /// Folder of the map (the one with manifest.kgs), or of the run that holds it.
    pub map: PathBuf,
    /// Write a PLY file.
    #[arg(long, value_name = "FILE", group = "format")]
    pub ply: Option<PathBuf>,
    /// Write an SPZ file; not available yet.
    #[arg(long, value_name = "FILE", group = "format")]
    pub spz: Option<PathBuf>,
}

/// What was exported.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ExportSummary {
    /// Gaussians in the file.
    pub gaussians: u64,
    /// Gaussians left out: a number that is not finite, or a keyframe that the log lost.
    pub left_out: u64,
    /// Pages left out because they are damaged.
    pub damaged_pages: u64,
}

/// Why nothing was exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// The map could not be read.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// A format that this version cannot write.
    #[error("exporting {path}: SPZ cannot be written by this version; use --ply FILE and convert that")]
    Unsupported {
        /// The file that was asked for.
        path: PathBuf,
    },
    /// The file could not be written.
    #[error("exporting to {path}: {source}; check that its folder exists and has room")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}

impl ExportError {
    /// The exit code of contracts.md.
    pub fn code(&self) -> u8 {
        match self {
            Self::Store(_) => StoreError::EXIT_CODE,
            Self::Unsupported { .. } => 2,
            Self::Write { .. } => 1,
        }
    }
}

/// Exports a map page by page, in the memory of one page.
///
/// # Errors
/// [`ExportError`] when the map cannot be opened or the file not be written; damaged pages are left out and logged.
pub fn run(args: &ExportArgs, max_keyframes: usize) -> Result<ExportSummary, ExportError> {
    let Some(file) = &args.ply else {
        return Err(ExportError::Unsupported { path: args.spz.clone().unwrap_or_default() });
    };
    let map = MapStoreReader::open(&map_folder(&args.map), max_keyframes)?;
    for damage in map.damages() {
        log::warn!("{}: left out: {damage}", args.map.display());
    }
    let bar = ProgressBar::new(2 * map.pages().len() as u64).with_style(progress_style());
    let summary = export_ply(&map, file, &bar);
    bar.finish_and_clear();
    let summary = summary?;
    log::info!(
        "{}: {} Gaussians written, {} left out, {} damaged pages",
        file.display(),
        summary.gaussians,
        summary.left_out,
        summary.damaged_pages
    );
    Ok(summary)
}

/// The map's own folder when a run's folder was given.
pub(crate) fn map_folder(given: &Path) -> PathBuf {
    let inside = given.join("map");
    if inside.join("manifest.kgs").exists() { inside } else { given.to_owned() }
}

fn progress_style() -> ProgressStyle {
    ProgressStyle::with_template("exporting {bar:40} {pos}/{len} pages, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Counts what is whole (a PLY says how much it holds before it holds it), then writes it.
fn export_ply(map: &MapStoreReader, file: &Path, bar: &ProgressBar) -> Result<ExportSummary, ExportError> {
    let write_error = |source| ExportError::Write { path: file.to_owned(), source };
    let mut summary = ExportSummary::default();
    let mut whole_pages = Vec::with_capacity(map.pages().len());
    let mut reading = PageWalk::new(map);
    for page in map.pages() {
        let before = summary;
        let walked = reading.walk(page, &mut |gaussian| {
            match gaussian {
                Some(_) => summary.gaussians += 1,
                None => summary.left_out += 1,
            }
            Ok(())
        });
        match walked {
            Ok(()) => whole_pages.push(*page),
            Err(WalkError::Store(problem)) => {
                log::warn!("left out: {problem}");
                summary = ExportSummary { damaged_pages: before.damaged_pages + 1, ..before };
            }
            Err(WalkError::Write(source)) => return Err(write_error(source)),
        }
        bar.inc(1);
    }
    let mut ply = PlyWriter::create(file, summary.gaussians).map_err(write_error)?;
    for page in &whole_pages {
        let walked = reading.walk(page, &mut |gaussian| gaussian.map_or(Ok(()), |gaussian| ply.push(gaussian)));
        match walked {
            Ok(()) => bar.inc(1),
            Err(WalkError::Store(problem)) => return Err(problem.into()),
            Err(WalkError::Write(source)) => return Err(write_error(source)),
        }
    }
    ply.finish().map_err(write_error)?;
    Ok(summary)
}

enum WalkError {
    Store(StoreError),
    Write(std::io::Error),
}

/// Reads pages one after the other in the same memory.
struct PageWalk<'m> {
    map: &'m MapStoreReader,
    buffer: Vec<u8>,
    gaussians: Vec<GaussianParams>,
}

impl<'m> PageWalk<'m> {
    fn new(map: &'m MapStoreReader) -> Self {
        let unused = GaussianParams {
            offset: [0.0; 3],
            log_scale: [0.0; 3],
            quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
            opacity_logit: 0.0,
            color_logit: [0.0; 3],
        };
        let gaussians = vec![unused; map.manifest().gaussians_per_anchor as usize];
        Self { map, buffer: Vec::new(), gaussians }
    }

    /// Hands every Gaussian of a page over, in map coordinates; `None` for one that cannot be shown.
    fn walk(
        &mut self,
        page: &PageLabel,
        found: &mut dyn FnMut(Option<&MapGaussian>) -> std::io::Result<()>,
    ) -> Result<(), WalkError> {
        let (_, mut reader) = self.map.read_page(page.page_id, &mut self.buffer).map_err(WalkError::Store)?;
        let mut keyframe: Option<&StoredKeyframe> = None;
        while let Some(anchor) = reader.next_anchor(&mut self.gaussians) {
            if keyframe.is_none_or(|known| known.keyframe_id != anchor.keyframe_id) {
                keyframe = self.map.keyframe(anchor.keyframe_id);
            }
            for params in self.gaussians.iter().take(usize::from(anchor.n_gaussians)) {
                let gaussian = keyframe.and_then(|keyframe| decode_gaussian(keyframe, &anchor, params));
                found(gaussian.as_ref()).map_err(WalkError::Write)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod picture_tests;
#[cfg(test)]
mod tests;
