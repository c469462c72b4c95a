//! `kilogs export`: a stored map as a file that other programs open.

mod decode;
mod finest;
mod part_file;
mod ply;
mod selection;
mod spz;
mod walk;

use crate::map_store::{MapStoreReader, StoreError};
use decode::{MapGaussian, decode_gaussian};
use finest::Shown;
use indicatif::{ProgressBar, ProgressStyle};
use ply::PlyWriter;
pub use selection::{Region, Selection};
use spz::{COLUMNS, SpzWriter};
use std::io;
use std::path::{Path, PathBuf};
use walk::{PageWalk, WalkError};

/// Options of `kilogs export`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Examples:\n  kilogs export out/04/map --ply street.ply\n  \
    kilogs export out/04/map --spz crossing.spz --region -20,0,20,100 --finest-level 2\n\n\
    A PLY file has the layout of the reference 3D Gaussian splatting; SuperSplat, antimatter15/splat and others open it. \
    An SPZ file has version 3 of Niantic's format, with y up and z back as it demands.")]
#[command(group(clap::ArgGroup::new("format").required(true).multiple(false)))]
pub struct ExportArgs {
    /// Folder of the map (the one with manifest.kgs), or of the run that holds it.
    pub map: PathBuf,
    /// Write a PLY file.
    #[arg(long, value_name = "FILE", group = "format")]
    pub ply: Option<PathBuf>,
    /// Write an SPZ file: Niantic's compressed format, a tenth of the size.
    #[arg(long, value_name = "FILE", group = "format")]
    pub spz: Option<PathBuf>,
    /// What goes into the file.
    #[command(flatten)]
    pub selection: Selection,
}

/// What was exported.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ExportSummary {
    /// Gaussians in the file.
    pub gaussians: u64,
    /// Gaussians of anchors that one of another level stands in for.
    pub other_levels: u64,
    /// Gaussians outside the region that was asked for.
    pub outside: u64,
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
    /// The file could not be written.
    #[error("exporting to {path}: {source}; check that its folder exists and has room")]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        source: io::Error,
    },
}

impl ExportError {
    /// The exit code of contracts.md.
    pub fn code(&self) -> u8 {
        match self {
            Self::Store(_) => StoreError::EXIT_CODE,
            Self::Write { .. } => 1,
        }
    }
}

/// Exports a map page by page, in the memory of one page, two bits per anchor, and 16 MiB for comparing levels.
///
/// # Errors
/// [`ExportError`] when the map cannot be opened or the file not be written; damaged pages are left out and logged.
pub fn run(args: &ExportArgs, max_keyframes: usize) -> Result<ExportSummary, ExportError> {
    // The command line takes exactly one of the two.
    let (file, is_spz) = match (&args.ply, &args.spz) {
        (Some(file), _) => (file, false),
        (None, spz) => (&spz.clone().unwrap_or_default(), true),
    };
    let map = MapStoreReader::open(&map_folder(&args.map), max_keyframes)?;
    for damage in map.damages() {
        log::warn!("{}: left out: {damage}", args.map.display());
    }
    let bar = ProgressBar::new(0).with_style(progress_style());
    let summary = export(&map, (file, is_spz), &args.selection, &bar);
    bar.finish_and_clear();
    let summary = summary?;
    let ExportSummary { gaussians, other_levels, outside, left_out, damaged_pages } = summary;
    log::info!(
        "{}: {gaussians} Gaussians written; left out: {other_levels} of other levels, {outside} outside, {left_out} lost, \
         {damaged_pages} damaged pages",
        file.display()
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

/// Finds out what is whole and shown (a file says how much it holds before it holds it), then writes it.
fn export(
    map: &MapStoreReader,
    (file, is_spz): (&Path, bool),
    selection: &Selection,
    bar: &ProgressBar,
) -> Result<ExportSummary, ExportError> {
    let write_error = |source| ExportError::Write { path: file.to_owned(), source };
    let in_words = |problem| match problem {
        WalkError::Store(problem) => ExportError::Store(problem),
        WalkError::Write(source) => write_error(source),
    };
    let mut reading = PageWalk::new(map);
    let mut summary = ExportSummary::default();
    let mut pages = map.pages().to_vec();
    pages.retain(|page| selection.admits_page(page));
    pages.retain(|page| {
        let verified = reading.verify(page).inspect_err(|problem| log::warn!("left out: {problem}"));
        summary.damaged_pages += u64::from(verified.is_err());
        verified.is_ok()
    });
    let n_writing = if is_spz { COLUMNS.len() } else { 1 };
    let n_comparing = if selection.all_levels { 0 } else { finest::n_passes(&pages) };
    bar.set_length(((1 + n_comparing + n_writing) * pages.len()) as u64);
    let shown = match selection.all_levels {
        true => Shown::all(0),
        false => finest::finest(&mut reading, &pages, selection.finest_level, || bar.inc(1)).map_err(in_words)?,
    };
    let mut reach_m = 0.0_f32;
    let counting = reading.walk(&pages, || bar.inc(1), &mut |walked| {
        for params in walked.gaussians {
            let decoded = walked.keyframe.and_then(|keyframe| decode_gaussian(keyframe, walked.anchor, params));
            match decoded {
                Some(_) if !shown.contains(walked.anchor_idx) => summary.other_levels += 1,
                Some(gaussian) if selection.admits(&gaussian) => {
                    summary.gaussians += 1;
                    reach_m = gaussian.mean_m.iter().fold(reach_m, |reach_m, coordinate| reach_m.max(coordinate.abs()));
                }
                Some(_) => summary.outside += 1,
                None => summary.left_out += 1,
            }
        }
        Ok(())
    });
    counting.map_err(in_words)?;
    let mut walk = |push: &mut dyn FnMut(&MapGaussian) -> io::Result<()>| {
        reading.walk(&pages, || bar.inc(1), &mut |walked| {
            let Some(keyframe) = walked.keyframe.filter(|_| shown.contains(walked.anchor_idx)) else { return Ok(()) };
            let decoded = |params| decode_gaussian(keyframe, walked.anchor, params);
            let mut wanted = walked.gaussians.iter().filter_map(decoded).filter(|gaussian| selection.admits(gaussian));
            wanted.try_for_each(|gaussian| push(&gaussian))
        })
    };
    if is_spz {
        let mut spz = SpzWriter::create(file, summary.gaussians, reach_m).map_err(write_error)?;
        for column in COLUMNS {
            walk(&mut |gaussian| spz.push(column, gaussian)).map_err(in_words)?;
        }
        spz.finish().map_err(write_error)?;
    } else {
        let mut ply = PlyWriter::create(file, summary.gaussians).map_err(write_error)?;
        walk(&mut |gaussian| ply.push(gaussian)).map_err(in_words)?;
        ply.finish().map_err(write_error)?;
    }
    Ok(summary)
}

#[cfg(test)]
mod picture_tests;
#[cfg(test)]
mod tests;
