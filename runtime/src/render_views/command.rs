//! `kilogs render`: views of a stored map along a trajectory.

pub use super::viewer::{RenderError, ViewRefused};
use super::{MapViewer, Picture};
use crate::export::map_folder;
use crate::map_store::MapStoreReader;
use crate::splat::{Overflow, SplatBackend};
use indicatif::{ProgressBar, ProgressStyle};
use std::path::PathBuf;

/// Options of `kilogs render`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Example:\n  kilogs render out/04/map --trajectory out/04/keyframes_tum.txt --out views")]
pub struct RenderArgs {
    /// Folder of the map (the one with manifest.kgs), or of the run that holds it.
    pub map: PathBuf,
    /// Where to look from: `t x y z qx qy qz qw` per line, camera in the map, m.
    #[arg(long, value_name = "FILE")]
    pub trajectory: PathBuf,
    /// Folder for the pictures, 000000.png for the first pose.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Opens the map to be rendered and reports what of it is damaged; its camera gives the size of the pictures.
///
/// # Errors
/// [`RenderError::Store`].
pub fn open(args: &RenderArgs, max_keyframes: usize) -> Result<MapStoreReader, RenderError> {
    let map = MapStoreReader::open(&map_folder(&args.map), max_keyframes)?;
    for damage in map.damages() {
        log::warn!("{}: left out: {damage}", args.map.display());
    }
    Ok(map)
}

/// Renders every pose of the trajectory with the map's camera; returns how many pictures were written.
///
/// # Errors
/// [`RenderError`] when the trajectory cannot be read, or a picture not drawn or written.
pub fn run(args: &RenderArgs, map: &MapStoreReader, backend: &mut dyn SplatBackend) -> Result<u64, RenderError> {
    let poses = kilogs_eval::trajectory::read_tum(&args.trajectory)?;
    let write_error =
        |reason: std::io::Error| RenderError::Write { path: args.out.clone(), reason: reason.to_string() };
    std::fs::create_dir_all(&args.out).map_err(write_error)?;
    let camera = map.manifest().camera;
    let mut picture = Picture::new(camera.width, camera.height);
    let mut viewer = MapViewer::new(map, backend);
    let style = ProgressStyle::with_template("rendering {bar:40} {pos}/{len} views, {eta} left");
    let bar = ProgressBar::new(poses.len() as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
    let mut n_written = 0;
    for pose in &poses {
        let chunk_id = viewer.chunk_near(&pose.world_from_camera.translation.vector);
        viewer
            .render(&pose.world_from_camera, &camera, chunk_id, &mut picture)
            .map_err(|source| RenderError::Refused { width: camera.width, height: camera.height, source })?;
        let path = args.out.join(format!("{n_written:06}.png"));
        let saved = picture.to_image().save(&path);
        saved.map_err(|source| RenderError::Write { path, reason: source.to_string() })?;
        n_written += 1;
        bar.inc(1);
    }
    bar.finish_and_clear();
    let counts = viewer.counts();
    if counts.overflow != Overflow::default() {
        log::warn!(
            "what is drawn is not complete: {} Gaussians, {} row entries and {} pairs found no room; raise [splat.*] in the budget",
            counts.overflow.visible_gaussians,
            counts.overflow.row_entries,
            counts.overflow.pairs
        );
    }
    log::info!("{n_written} views; {} pages loaded, {} damaged", counts.pages_loaded, counts.pages_damaged);
    Ok(n_written)
}
