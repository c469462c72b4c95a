//! Camera geometry: where a ray meets the image, and what a lens does to it.
//!
//! Everything but this folder knows the ideal [`Pinhole`] only: images of a real lens are rectified where they come in.

mod lens;
pub mod rectify;

pub use lens::{Lens, LensFolds};

use nalgebra::{Vector2, Vector3};

/// Ideal pinhole camera; pixel centres at +0.5 (see [`conventions`](crate::conventions)).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// Image width, px.
    pub width: u32,
    /// Image height, px.
    pub height: u32,
    /// Focal length along x, px.
    pub fx: f64,
    /// Focal length along y, px.
    pub fy: f64,
    /// Principal point, px.
    pub cx: f64,
    /// Principal point, px.
    pub cy: f64,
}

impl Pinhole {
    /// Pixel of a point in the camera's frame, `None` at or behind the camera plane.
    pub fn project(&self, point_in_camera: &Vector3<f64>) -> Option<Vector2<f64>> {
        (point_in_camera.z > 0.0).then(|| {
            Vector2::new(
                self.fx * point_in_camera.x / point_in_camera.z + self.cx,
                self.fy * point_in_camera.y / point_in_camera.z + self.cy,
            )
        })
    }

    /// Normalised image coordinates (plane z = 1) of a pixel.
    pub fn unproject_z1(&self, pixel: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy)
    }

    /// The same camera read out at another size (mapping resolution, pyramid levels).
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let sx = f64::from(width) / f64::from(self.width);
        let sy = f64::from(height) / f64::from(self.height);
        Self { width, height, fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy }
    }
}

/// How the camera sits on the vehicle.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mounting {
    /// Height of the camera's centre over the road, m.
    pub height_m: f64,
    /// Nose-down angle of the optical axis against the road, rad.
    pub pitch_rad: f64,
    /// Rotation about the optical axis against the road, rad; positive when the right side is lower.
    pub roll_rad: f64,
    /// The vehicle's forward axis in the camera's frame, unit length.
    pub forward_axis: [f64; 3],
    /// Rear axle seen from the camera, m, camera axes.
    pub lever_arm_m: [f64; 3],
}

impl Mounting {
    /// Unit normal of the road in camera axes, pointing from the camera down to the road.
    pub fn road_normal_in_camera(&self) -> Vector3<f64> {
        let (sin_pitch, cos_pitch) = (libm::sin(self.pitch_rad), libm::cos(self.pitch_rad));
        let (sin_roll, cos_roll) = (libm::sin(self.roll_rad), libm::cos(self.roll_rad));
        Vector3::new(cos_pitch * sin_roll, cos_pitch * cos_roll, sin_pitch)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { width: 100, height: 60, fx: 80.0, fy: 90.0, cx: 50.0, cy: 30.0 };

    #[test]
    fn a_hand_computed_point_lands_on_its_pixel() {
        let pixel = CAMERA.project(&Vector3::new(1.0, -2.0, 4.0));
        assert_eq!(pixel, Some(Vector2::new(70.0, -15.0)));
        assert_eq!(CAMERA.unproject_z1(&Vector2::new(70.0, -15.0)), Vector2::new(0.25, -0.5));
        assert_eq!(CAMERA.project(&Vector3::new(1.0, 1.0, 0.0)), None);
    }

    #[test]
    fn half_size_keeps_the_corner_of_the_image_at_zero() {
        let half = CAMERA.resized(50, 30);
        let point = Vector3::new(0.3, 0.2, 1.0);
        let (full_px, half_px) = (CAMERA.project(&point), half.project(&point));
        assert_eq!(full_px.map(|p| p * 0.5), half_px);
    }

    #[test]
    fn a_camera_looking_down_sees_the_road_ahead_of_it() {
        let mounting = Mounting {
            height_m: 1.65,
            pitch_rad: 0.1,
            roll_rad: 0.0,
            forward_axis: [0.0, 0.0, 1.0],
            lever_arm_m: [0.0; 3],
        };
        let normal = mounting.road_normal_in_camera();
        assert!(normal.z > 0.0 && normal.y > 0.9 && normal.x == 0.0, "{normal}");
    }
}
