//! Metric depth from one image, by whatever network the manifest has for it.

use super::ModelError;
use super::manifest::{DepthUnit, Manifest, Role};
use super::network::Network;
use super::picture::{Fit, Picture, bilinear};
use tract_onnx::prelude::tvec;

/// A depth network for one camera.
#[derive(Debug)]
pub(super) struct DepthNetwork {
    network: Network,
    /// Mean and standard deviation of each channel.
    channels: Vec<(f32, f32)>,
    unit: DepthUnit,
    trained_focal_px: Option<f32>,
    camera_focal_px: f32,
}

impl DepthNetwork {
    /// The first depth network of the manifest.
    pub(super) fn load(manifest: &Manifest, camera_focal_px: f32) -> Result<Self, ModelError> {
        let row = manifest.first(Role::MetricDepth)?;
        let no_row = || ModelError::NoRow { manifest: row.file.clone().into(), role: Role::MetricDepth };
        let depth = row.depth.clone().ok_or_else(no_row)?;
        Ok(Self {
            network: Network::load(manifest, row)?,
            channels: depth.mean.into_iter().zip(depth.std).collect(),
            unit: depth.output,
            trained_focal_px: depth.focal_px,
            camera_focal_px,
        })
    }

    /// Writes the depth at each pixel of the camera, m; not a number where the network has none.
    pub(super) fn depths_m(
        &self,
        picture: &Picture,
        pixels: &[[f32; 2]],
        depths_m: &mut [f32],
    ) -> Result<(), ModelError> {
        let row = self.network.row();
        let fit = Fit::new((picture.width, picture.height), row.image_size());
        let image = self.network.input(0, &fit.planes(picture, &self.channels))?;
        let outputs = self.network.run(tvec![image])?;
        let map = self.network.numbers(&outputs[0])?;
        let &[_, _, height, width] = row.outputs[0].shape.as_slice() else { return Ok(()) };
        let focal_ratio = self.trained_focal_px.map_or(1.0, |trained| self.camera_focal_px * fit.scale[0] / trained);
        for (pixel, depth_m) in pixels.iter().zip(depths_m) {
            let [x, y] = fit.network_px(*pixel);
            let is_inside = x >= 0.0 && y >= 0.0 && x < fit.content.0 as f32 && y < fit.content.1 as f32;
            let (u, v) = (x * width as f32 / fit.input.0 as f32, y * height as f32 / fit.input.1 as f32);
            let value = if is_inside { bilinear(map, (width, height), u, v) } else { f32::NAN };
            let found_m = match self.unit {
                DepthUnit::Metres => value,
                DepthUnit::InverseMetres => 1.0 / value,
            };
            *depth_m = if found_m.is_finite() && found_m > 0.0 { found_m * focal_ratio } else { f32::NAN };
        }
        Ok(())
    }
}
