//! Grey images of a recording or of a simulated street, and the features in them.

use crate::error::PlacesError;
use kilogs_camera::camera_file::CameraArgument;
use kilogs_camera::sim::{SimArgs, Simulator};
use kilogs_camera::source::{FolderSource, FrameInfo, FrameSource, Playback, PlaybackRange, SourceFormat};
use kilogs_core::features::corners::Corner;
use kilogs_core::features::descriptors::{ExtractScratch, extract, half_step_bytes};
use kilogs_core::features::{ExtractSettings, Feature, SimdLevel};
use kilogs_core::frame::gray::to_gray;
use kilogs_core::frame::{ImageView, Pyramid, pyramid};
use kilogs_core::tracking::PYRAMID_LEVELS;
use std::path::Path;

/// Images one after the other, in grey.
pub(crate) struct Frames {
    source: Box<dyn FrameSource>,
    format: SourceFormat,
    pixels: Vec<u8>,
    gray: Vec<u8>,
}

impl Frames {
    /// A recorded folder.
    pub(crate) fn of_folder(folder: &Path, range: &PlaybackRange) -> Result<Self, PlacesError> {
        let source = FolderSource::open(folder, Some(&CameraArgument::Kitti), None)?;
        Ok(Self::of(Box::new(Playback::new(source, range)?)))
    }

    /// A simulated street.
    pub(crate) fn of_street(seed: u64) -> Result<Self, PlacesError> {
        let args = SimArgs { seed, mono: true, width: 1241, height: 376, ..SimArgs::default() };
        let street = Simulator::new(&args).map_err(|error| PlacesError::Simulation(error.to_string()))?;
        Ok(Self::of(Box::new(street)))
    }

    fn of(source: Box<dyn FrameSource>) -> Self {
        let format = source.format();
        let n_pixels = format.camera.width as usize * format.camera.height as usize;
        Self { source, format, pixels: vec![0; format.frame_bytes() as usize], gray: vec![0; n_pixels] }
    }

    /// What all images have in common.
    pub(crate) fn format(&self) -> SourceFormat {
        self.format
    }

    /// The next image; `None` at the end.
    pub(crate) fn next(&mut self) -> Result<Option<(ImageView<'_>, FrameInfo)>, PlacesError> {
        let Some(info) = self.source.next_frame(&mut self.pixels)? else { return Ok(None) };
        let (width, height) = (self.format.camera.width as usize, self.format.camera.height as usize);
        let stride = self.format.pixel_format.row_bytes(self.format.camera.width) as usize;
        to_gray(self.format.pixel_format, &self.pixels, (width, height), stride, &mut self.gray)?;
        Ok(Some((ImageView::new(&self.gray, width, height, width)?, info)))
    }
}

/// Finds the features of images of one size.
pub(crate) struct Extractor {
    pyramid: Vec<u8>,
    size: [usize; 2],
    half_step: Vec<u8>,
    corners: Vec<Corner>,
    features: Vec<Feature>,
}

impl Extractor {
    /// For images of this format, with at most so many features each.
    pub(crate) fn new(format: &SourceFormat, n_features: usize) -> Self {
        let size = [format.camera.width as usize, format.camera.height as usize];
        Self {
            pyramid: vec![0; pyramid::bytes_needed(size[0], size[1], PYRAMID_LEVELS)],
            size,
            half_step: vec![0; half_step_bytes(size[0], size[1])],
            corners: vec![Corner::NONE; n_features.div_ceil(2)],
            features: vec![Feature::NONE; n_features],
        }
    }

    /// The features of an image.
    pub(crate) fn features(&mut self, image: ImageView<'_>) -> Result<&[Feature], PlacesError> {
        self.look(image, |_| ()).map(|(features, ())| features)
    }

    /// The features of an image, and what `look` makes of its pyramid.
    pub(crate) fn look<T>(
        &mut self,
        image: ImageView<'_>,
        look: impl FnOnce(&Pyramid<'_>) -> T,
    ) -> Result<(&[Feature], T), PlacesError> {
        let mut pyramid = Pyramid::new(&mut self.pyramid, self.size[0], self.size[1], PYRAMID_LEVELS)?;
        pyramid.build(image)?;
        let mut scratch = ExtractScratch { half_step: &mut self.half_step, corners: &mut self.corners };
        let settings = ExtractSettings::STANDARD;
        let n = extract(SimdLevel::new(), &pyramid, &settings, &mut scratch, &mut self.features);
        Ok((&self.features[..n], look(&pyramid)))
    }
}
