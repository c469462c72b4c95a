//! Depth for insertion: where along its ray the surface of a pixel lies, and how sure that is.
//!
//! Two sources from the start: [`sparse`] spreads triangulated points, [`motion_stereo`] compares the keyframe
//! with earlier ones. A network would be a third. What no source is sure of gets no Gaussian.

pub mod aggregate;
pub mod census;
pub mod motion_stereo;
pub mod readout;
pub mod sparse;
pub mod sweep;

use super::insertion::MapImageSize;
use crate::camera::Pinhole;
use crate::conventions::Rigid;
use crate::tracking::{KeyframePoint, RoadPlane};
use nalgebra::Vector3;

/// An earlier keyframe that saw the same street.
#[derive(Debug, Clone, Copy)]
pub struct EarlierView<'a> {
    /// Brightness at mapping resolution, row by row.
    pub luma: &'a [u8],
    /// Where it was.
    pub world_from_camera: Rigid,
}

/// What a depth source may look at.
#[derive(Debug, Clone, Copy)]
pub struct DepthRequest<'a> {
    /// Intrinsics at mapping resolution.
    pub camera: Pinhole,
    /// Brightness at mapping resolution, row by row.
    pub luma: &'a [u8],
    /// Where the keyframe is.
    pub world_from_camera: Rigid,
    /// Earlier keyframes, newest first.
    pub earlier: &'a [EarlierView<'a>],
    /// Triangulated tracks, in pixels of the native image.
    pub points: &'a [KeyframePoint],
    /// Native pixels per pixel at mapping resolution.
    pub native_per_map_px: [f64; 2],
    /// The road, where it was seen.
    pub road: Option<RoadPlane>,
}

impl DepthRequest<'_> {
    /// Size at mapping resolution.
    pub fn size(&self) -> MapImageSize {
        MapImageSize { width: self.camera.width as usize, height: self.camera.height as usize }
    }

    /// Pixel of a triangulated point at mapping resolution.
    pub fn map_pixel(&self, point: &KeyframePoint) -> [f64; 2] {
        let [x, y] = point.pixel.map(f64::from);
        [x / self.native_per_map_px[0], y / self.native_per_map_px[1]]
    }
}

/// Where a depth source writes, one value per pixel at mapping resolution.
#[derive(Debug)]
pub struct DepthImage<'m> {
    /// Inverse depth along the optical axis, 1/m; 0 where nothing is known or the surface is infinitely far.
    pub inverse_depth: &'m mut [f32],
    /// How sure that is, in [0, 1]; 0 means: insert nothing.
    pub confidence: &'m mut [f32],
}

/// Inverse depth at which a pixel's ray meets the road, 1/m; not positive above the horizon.
pub fn road_inverse_depth(road: &RoadPlane, camera: &Pinhole, pixel: [f64; 2]) -> f64 {
    let ray = Vector3::new((pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0);
    Vector3::from(road.normal_in_camera).dot(&ray) / road.height_m
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_road_is_twice_as_near_twice_as_far_below_the_horizon() {
        let camera = Pinhole { width: 100, height: 60, fx: 80.0, fy: 80.0, cx: 50.0, cy: 30.0 };
        let road = RoadPlane { normal_in_camera: [0.0, 1.0, 0.0], height_m: 1.6 };
        for (y, expected) in [(30.0, 0.0), (38.0, 1.0 / 16.0), (46.0, 1.0 / 8.0), (22.0, -1.0 / 16.0)] {
            assert!((road_inverse_depth(&road, &camera, [10.0, y]) - expected).abs() < 1e-12, "row {y}");
        }
    }
}
