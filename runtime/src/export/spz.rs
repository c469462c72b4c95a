//! Niantic's SPZ, version 3: gzip of a header and one column per property.
//!
//! Written from the format's public description (github.com/nianticlabs/spz, README): positions in fixed point, everything
//! else in 8 bits but rotations, whose three smaller components have 10 bits each. Axes are right, up, back.

use super::decode::MapGaussian;
use super::part_file::PartFile;
use flate2::Compression;
use flate2::write::GzEncoder;
use std::f32::consts::SQRT_2;
use std::io::{self, Write};
use std::path::Path;

/// "NGSP".
pub(super) const MAGIC: u32 = 0x5053_474e;
pub(super) const VERSION: u32 = 3;
/// Most fractional bits of a coordinate: 0.24 mm, and the reach is 2 km.
const MAX_FRACTIONAL_BITS: u32 = 12;
/// Coordinates have 24 bits with their sign.
const LARGEST_FIXED: f32 = ((1 << 23) - 1) as f32;
/// Colors are `0.15 * dc + 0.5`, dc the zeroth harmonic's factor `(rgb - 0.5) / 0.282`: brighter ones still fit.
pub(super) const COLOR_SCALE: f32 = 0.15 / 0.282_094_79;
/// A component that is not the largest is below this share of 1.
const LARGEST_SMALL: f32 = SQRT_2 / 2.0;
const COMPONENT_STEPS: f32 = 511.0;

/// The columns in their order.
pub(super) const COLUMNS: [Column; 5] =
    [Column::Position, Column::Opacity, Column::Color, Column::Scale, Column::Rotation];

/// One property of all Gaussians.
#[derive(Debug, Clone, Copy)]
pub(super) enum Column {
    Position,
    Opacity,
    Color,
    Scale,
    Rotation,
}

/// Writes an SPZ file column by column.
pub(super) struct SpzWriter {
    out: GzEncoder<PartFile>,
    fractional_bits: u32,
}

impl SpzWriter {
    /// Begins a file of `n_gaussians` Gaussians whose coordinates are at most `reach_m`.
    pub(super) fn create(path: &Path, n_gaussians: u64, reach_m: f32) -> io::Result<Self> {
        let n_gaussians = u32::try_from(n_gaussians).map_err(io::Error::other)?;
        let fractional_bits = fractional_bits(reach_m);
        let mut out = GzEncoder::new(PartFile::create(path)?, Compression::default());
        for number in [MAGIC, VERSION, n_gaussians] {
            out.write_all(&number.to_le_bytes())?;
        }
        // No further harmonics, no flags.
        out.write_all(&[0, fractional_bits as u8, 0, 0])?;
        Ok(Self { out, fractional_bits })
    }

    /// Appends a Gaussian to the column that is being written.
    pub(super) fn push(&mut self, column: Column, gaussian: &MapGaussian) -> io::Result<()> {
        match column {
            Column::Position => {
                let [right, down, forward] = gaussian.mean_m;
                [right, -down, -forward].iter().try_for_each(|meters| self.push_fixed(*meters))
            }
            Column::Opacity => self.push_unit(1.0 / (1.0 + (-gaussian.opacity_logit).exp())),
            Column::Color => {
                gaussian.rgb.iter().try_for_each(|channel| self.push_unit((channel - 0.5) * COLOR_SCALE + 0.5))
            }
            Column::Scale => gaussian.log_deviation.iter().try_for_each(|log| self.push_byte((log + 10.0) * 16.0)),
            Column::Rotation => {
                let [x, y, z, w] = gaussian.rotation_xyzw;
                self.out.write_all(&pack_rotation([x, -y, -z, w]).to_le_bytes())
            }
        }
    }

    pub(super) fn finish(self) -> io::Result<()> {
        self.out.finish()?.finish()
    }

    fn push_fixed(&mut self, meters: f32) -> io::Result<()> {
        let steps = (meters * (1u32 << self.fractional_bits) as f32).round().clamp(-LARGEST_FIXED, LARGEST_FIXED);
        let [low, middle, high, _] = (steps as i32).to_le_bytes();
        self.out.write_all(&[low, middle, high])
    }

    fn push_unit(&mut self, share: f32) -> io::Result<()> {
        self.push_byte(share * 255.0)
    }

    fn push_byte(&mut self, value: f32) -> io::Result<()> {
        self.out.write_all(&[value.round().clamp(0.0, 255.0) as u8])
    }
}

/// As many as leave room for the farthest coordinate.
fn fractional_bits(reach_m: f32) -> u32 {
    (0..=MAX_FRACTIONAL_BITS).rev().find(|bits| reach_m * (1u32 << bits) as f32 <= LARGEST_FIXED).unwrap_or(0)
}

/// Place of the largest component, then sign and size of the others from x to w.
fn pack_rotation(xyzw: [f32; 4]) -> u32 {
    let largest = (1..4).fold(0, |largest, i| if xyzw[i].abs() > xyzw[largest].abs() { i } else { largest });
    let is_turned = xyzw[largest] < 0.0;
    let mut packed = largest as u32;
    for (i, component) in xyzw.iter().enumerate() {
        if i != largest {
            let is_negative = (*component < 0.0) != is_turned;
            let steps = (component.abs() / LARGEST_SMALL * COMPONENT_STEPS).round().min(COMPONENT_STEPS) as u32;
            packed = (packed << 10) | (u32::from(is_negative) << 9) | steps;
        }
    }
    packed
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rotations_keep_the_signs_and_sizes_of_their_three_smaller_components() {
        let check = |xyzw: [f32; 4], expected: [u32; 4]| {
            let [largest, a, b, c] = expected;
            assert_eq!(pack_rotation(xyzw), largest << 30 | a << 20 | b << 10 | c, "{xyzw:?}");
        };
        // 0.5 is 361 steps of sqrt(1/2) / 511, 0.1 is 72; bit 9 is the sign.
        check([0.0, 0.0, 0.0, 1.0], [3, 0, 0, 0]);
        check([0.5, -0.5, 0.1, 0.7], [3, 361, 512 + 361, 72]);
        check([0.5, -0.5, 0.1, -0.7], [3, 512 + 361, 361, 512 + 72]);
        check([-0.9, 0.1, 0.0, -0.1], [0, 512 + 72, 512, 72]);
    }

    #[test]
    fn a_long_route_is_stored_less_finely() {
        for (reach_m, bits) in [(1.0, 12), (2047.9, 12), (2048.1, 11), (5000.0, 10), (1e9, 0)] {
            assert_eq!(fractional_bits(reach_m), bits, "{reach_m} m");
        }
    }
}
