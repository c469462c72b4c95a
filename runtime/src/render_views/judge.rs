//! How good a stored map looks from where it was made and from where it was not.

use super::viewer::{RenderError, map_from_camera};
use super::{MapViewer, Picture, ViewerCounts};
use crate::map_store::MapStoreReader;
use crate::splat::SplatBackend;
use image::RgbImage;
use indicatif::{ProgressBar, ProgressStyle};
use kilogs_core::frame::PixelFormat;
use kilogs_core::store::StoredKeyframe;
use kilogs_eval::image_quality::{ImageProblem, ImageQuality, ImageQualityMeter, ImageShape, QualityAverage};
use nalgebra::Vector3;

/// A view that was judged.
#[derive(Debug, Clone, Copy)]
pub struct JudgedView<'a> {
    /// Which view; `is_held_out` says of which kind.
    pub keyframe: &'a StoredKeyframe,
    /// Metres driven along the keyframes so far.
    pub driven_m: f64,
    /// What it scores.
    pub quality: ImageQuality,
    /// The render.
    pub render: &'a Picture,
    /// The camera's image, as stored.
    pub camera: &'a RgbImage,
}

/// What a map scores.
#[derive(Debug, Clone, Default)]
pub struct MapQuality {
    /// Mapping keyframes.
    pub train: QualityAverage,
    /// Held-out views.
    pub held_out: QualityAverage,
    /// Views without the image that they should have, in none of the averages.
    pub views_skipped: u64,
    /// Keyframes that were stored without a picture.
    pub views_without_picture: u64,
    /// How the map was loaded.
    pub viewer: ViewerCounts,
}

/// Renders every stored view of `map` at native resolution, in the order of the drive, and compares it with the
/// stored image: no correction of any kind. An image of a grey camera is compared with the mean of the render's
/// channels. `observe` sees every judged view.
///
/// The images are those of the store, JPEG; at the default quality the loss is about 40 dB and does not show in
/// figures below 30 dB.
///
/// # Errors
/// [`RenderError`] when the backend refuses the map's picture size, or whatever `observe` returns.
pub fn judge_map(
    map: &MapStoreReader,
    backend: &mut dyn SplatBackend,
    observe: &mut dyn FnMut(&JudgedView<'_>) -> Result<(), RenderError>,
) -> Result<MapQuality, RenderError> {
    let camera = map.manifest().camera;
    let refused = |source| RenderError::Refused { width: camera.width, height: camera.height, source };
    let mut views: Vec<&StoredKeyframe> = map.keyframes().iter().chain(map.held_out()).collect();
    views.sort_by_key(|view| view.frame_index);
    let bar = ProgressBar::new(views.len() as u64).with_style(progress_style());

    let mut comparison = Comparison::new(map);
    let mut picture = Picture::new(camera.width, camera.height);
    let mut viewer = MapViewer::new(map, backend);
    let mut quality = MapQuality::default();
    let mut driven = Driven::default();
    for view in views {
        bar.inc(1);
        let driven_m = driven.at(view);
        if view.image_bytes == 0 {
            quality.views_without_picture += 1;
            continue;
        }
        let image = match map.read_image(view) {
            Ok(image) => image,
            Err(problem) => {
                log::warn!("frame {} is left out of the figures: {problem}", view.frame_index);
                quality.views_skipped += 1;
                continue;
            }
        };
        viewer.render(&map_from_camera(view), &camera, view.chunk_id, &mut picture).map_err(refused)?;
        let Ok(scores) = comparison.judge(&picture, &image) else {
            quality.views_skipped += 1;
            continue;
        };
        let average = if view.is_held_out { &mut quality.held_out } else { &mut quality.train };
        average.push(driven_m, scores);
        observe(&JudgedView { keyframe: view, driven_m, quality: scores, render: &picture, camera: &image })?;
    }
    bar.finish_and_clear();
    quality.viewer = viewer.counts();
    Ok(quality)
}

fn progress_style() -> ProgressStyle {
    ProgressStyle::with_template("judging {bar:40} {pos}/{len} views, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar())
}

/// Metres along the mapping keyframes.
#[derive(Default)]
struct Driven {
    last_m: Option<Vector3<f64>>,
    sum_m: f64,
}

impl Driven {
    fn at(&mut self, view: &StoredKeyframe) -> f64 {
        if !view.is_held_out {
            let position_m = Vector3::from(view.translation_m);
            self.sum_m += self.last_m.map_or(0.0, |last_m| (position_m - last_m).norm());
            self.last_m = Some(position_m);
        }
        self.sum_m
    }
}

/// Compares pictures with camera images in as many channels as the camera has.
struct Comparison {
    meter: ImageQualityMeter,
    is_grey: bool,
    grey_render: Vec<f32>,
    grey_camera: Vec<u8>,
}

impl Comparison {
    fn new(map: &MapStoreReader) -> Self {
        let camera = map.manifest().camera;
        let is_grey = map.manifest().pixel_format == PixelFormat::Mono8;
        let shape = ImageShape {
            width: camera.width as usize,
            height: camera.height as usize,
            channels: if is_grey { 1 } else { 3 },
        };
        Self { meter: ImageQualityMeter::new(shape), is_grey, grey_render: Vec::new(), grey_camera: Vec::new() }
    }

    fn judge(&mut self, picture: &Picture, camera: &RgbImage) -> Result<ImageQuality, ImageProblem> {
        if !self.is_grey {
            return self.meter.judge(picture.rgb().as_flattened(), camera.as_raw().as_slice());
        }
        self.grey_render.clear();
        self.grey_render.extend(picture.shown(true).map(|[grey, ..]| grey));
        self.grey_camera.clear();
        self.grey_camera.extend(camera.pixels().map(|pixel| pixel.0[1]));
        self.meter.judge(&self.grey_render, &self.grey_camera)
    }
}
