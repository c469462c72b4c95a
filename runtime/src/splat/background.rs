//! The far background: one directional color table per chunk, behind everything.
//!
//! Nothing supports a Gaussian in the sky, so the sky is not made of Gaussians: the last of a pixel's
//! transmittance shows a table of colors by direction, equirectangular about the map's vertical axis (`-y` is up).

use super::kernel_constants as constants;
use nalgebra::Vector3;

pub use super::kernel_constants::{BACKGROUND_MAX_ELEVATION_RAD, BACKGROUND_MIN_ELEVATION_RAD};

/// Texels around the horizon; column 0 is centred half a texel to the right of the map's forward axis (`+z`).
pub const BACKGROUND_COLUMNS: usize = constants::BACKGROUND_COLUMNS as usize;
/// Texels from the lowest to the highest elevation.
pub const BACKGROUND_ROWS: usize = constants::BACKGROUND_ROWS as usize;
/// Texels of one table.
pub const BACKGROUND_TEXELS: usize = BACKGROUND_COLUMNS * BACKGROUND_ROWS;

/// Unit direction, in map axes, of the centre of a texel.
pub fn background_texel_direction(column: usize, row: usize) -> Vector3<f32> {
    let azimuth_rad = (column as f32 + 0.5) / BACKGROUND_COLUMNS as f32 * core::f32::consts::TAU;
    let fraction = (row as f32 + 0.5) / BACKGROUND_ROWS as f32;
    let elevation_rad =
        BACKGROUND_MIN_ELEVATION_RAD + fraction * (BACKGROUND_MAX_ELEVATION_RAD - BACKGROUND_MIN_ELEVATION_RAD);
    let (sin_azimuth, cos_azimuth) = azimuth_rad.sin_cos();
    let (sin_elevation, cos_elevation) = elevation_rad.sin_cos();
    Vector3::new(sin_azimuth * cos_elevation, -sin_elevation, cos_azimuth * cos_elevation)
}
