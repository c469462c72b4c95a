//! A deformed window of an image, interpolated onto a square grid.

use super::affine::Placement;
use crate::frame::pyramid::{MARGIN_PX, PaddedImage};

/// Fractional bits of a coordinate: 2^15 px of image fit beside them, and ten steps are off by 10^-4 px at most.
const FRACTION_BITS: i32 = 16;
const ONE: f32 = (1u32 << FRACTION_BITS) as f32;

/// Interpolates bilinearly at `center + shape * w`, where w runs over the grid of `ROWS` x `ROWS` offsets around zero;
/// columns beyond are left alone. `None` when a corner lies outside image and margin or is no number.
#[inline(always)]
pub(crate) fn sample<const COLUMNS: usize, const ROWS: usize>(
    level: &PaddedImage<'_>,
    placement: &Placement,
    values: &mut [[f32; COLUMNS]; ROWS],
) -> Option<()> {
    const { assert!(ROWS <= COLUMNS) };
    let half = (ROWS / 2) as f32;
    let [[a, b], [c, d]] = placement.shape;
    // Coordinates in the stored level, whose first byte is the centre of pixel (-margin, -margin).
    let to_stored = MARGIN_PX as f32 - 0.5;
    let [cx, cy] = placement.center_px.map(|coordinate| coordinate + to_stored);
    let (reach_x, reach_y) = (half * (a.abs() + b.abs()), half * (c.abs() + d.abs()));
    // One pixel for the neighbour that is interpolated with, one for rounding.
    let last_x = (level.width() + 2 * MARGIN_PX - 2) as f32;
    let last_y = (level.height() + 2 * MARGIN_PX - 2) as f32;
    let is_inside = cx - reach_x >= 1.0 && cy - reach_y >= 1.0 && cx + reach_x < last_x && cy + reach_y < last_y;
    if !is_inside {
        return None;
    }
    let margin = MARGIN_PX as i32;
    let bytes = level.from_pixel(-margin, -margin)?;
    let stride = level.stride();
    let [step_x, step_y] = [a, c].map(|step| (step * ONE) as i32);
    for (r, row) in values.iter_mut().enumerate() {
        let wy = r as f32 - half;
        let x = ((cx + b * wy - half * a) * ONE) as i32;
        let y = ((cy + d * wy - half * c) * ONE) as i32;
        let (mut starts, mut fractions) = ([0i32; COLUMNS], [[0i32; COLUMNS]; 2]);
        for i in 0..COLUMNS {
            let x = x.wrapping_add(step_x.wrapping_mul(i as i32));
            let y = y.wrapping_add(step_y.wrapping_mul(i as i32));
            starts[i] = (y >> FRACTION_BITS).wrapping_mul(stride as i32).wrapping_add(x >> FRACTION_BITS);
            fractions[0][i] = x & ((1 << FRACTION_BITS) - 1);
            fractions[1][i] = y & ((1 << FRACTION_BITS) - 1);
        }
        // Two pixels of two rows, a byte each.
        let mut corners = [0u32; COLUMNS];
        for i in 0..ROWS {
            let start = starts[i] as usize;
            let rows = bytes.get(start..start + stride + 2)?;
            let (&[a, b], &[c, d]) = (rows.first_chunk()?, rows.last_chunk()?);
            corners[i] = u32::from_le_bytes([a, b, c, d]);
        }
        let mut blended = [0.0f32; COLUMNS];
        for i in 0..COLUMNS {
            let (fx, fy) = (fractions[0][i] as f32 / ONE, fractions[1][i] as f32 / ONE);
            let pixel = |byte: u32| (corners[i] >> (8 * byte) & 0xff) as i32 as f32;
            let (p00, p01, p10, p11) = (pixel(0), pixel(1), pixel(2), pixel(3));
            let (upper, lower) = (p00 + fx * (p01 - p00), p10 + fx * (p11 - p10));
            blended[i] = upper + fy * (lower - upper);
        }
        row[..ROWS].copy_from_slice(&blended[..ROWS]);
    }
    Some(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::pyramid::bytes_needed;
    use crate::frame::{ImageView, Pyramid};
    use std::vec;
    use std::vec::Vec;

    #[test]
    fn a_ramp_is_read_at_the_deformed_positions_and_nowhere_else() {
        let value = |x: f32, y: f32| 2.0 * x + 1.0 * y;
        let pixels: Vec<u8> = (0..60 * 50).map(|i| value((i % 60) as f32 + 0.5, (i / 60) as f32 + 0.5) as u8).collect();
        let mut storage = vec![0; bytes_needed(60, 50, 1)];
        let mut pyramid = Pyramid::new(&mut storage, 60, 50, 1).expect("asked for its size");
        pyramid.build(ImageView::new(&pixels, 60, 50, 60).expect("sized")).expect("same size");
        let level = pyramid.level(0).expect("one level");
        let placement = Placement { center_px: [30.3, 24.8], shape: [[1.3, 0.2], [-0.1, 0.7]] };
        let mut values = [[-1.0f32; 9]; 7];
        assert_eq!(sample(&level, &placement, &mut values), Some(()));
        for (r, row) in values.iter().enumerate() {
            for (i, &found) in row.iter().enumerate() {
                let (wx, wy) = (i as f32 - 3.0, r as f32 - 3.0);
                let expected = value(30.3 + 1.3 * wx + 0.2 * wy, 24.8 - 0.1 * wx + 0.7 * wy);
                // The stored ramp is cut to whole grey values, half a grey value below on average.
                let is_read = (found - expected).abs() < 0.51 + 1e-2;
                assert!(if i < 7 { is_read } else { found == -1.0 }, "({r}, {i}): {found} {expected}");
            }
        }
        for center_px in [[-13.0, 20.0], [73.0, 20.0], [30.0, 63.0], [f32::NAN, 20.0], [30.0, f32::INFINITY]] {
            assert_eq!(sample(&level, &Placement::at(center_px), &mut values), None, "{center_px:?}");
        }
    }
}
