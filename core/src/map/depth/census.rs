//! Census transform: a pixel described by which of its neighbours are darker, blind to exposure.

use crate::map::insertion::MapImageSize;

/// Half side of the window, px; 7x7 without the middle gives 48 bits.
pub const CENSUS_RADIUS: usize = 3;
/// Bits of a descriptor, and the largest distance between two.
pub const CENSUS_BITS: u32 = 48;

/// Writes the descriptor of every pixel; the window is clamped at the borders.
///
/// # Source
/// Zabih & Woodfill 1994, "Non-parametric local transforms for computing visual correspondence".
pub fn census(luma: &[u8], size: MapImageSize, descriptors: &mut [u64]) {
    let MapImageSize { width, height } = size;
    let (last_x, last_y) = (width.saturating_sub(1), height.saturating_sub(1));
    for (y, row) in descriptors.chunks_exact_mut(width.max(1)).enumerate().take(height) {
        for (x, descriptor) in row.iter_mut().enumerate() {
            let at = |x: usize, y: usize| luma.get(y * width + x).copied().unwrap_or(0);
            let middle = at(x, y);
            let mut bits = 0u64;
            for dy in 0..=2 * CENSUS_RADIUS {
                let v = (y + dy).saturating_sub(CENSUS_RADIUS).min(last_y);
                for dx in 0..=2 * CENSUS_RADIUS {
                    if (dx, dy) != (CENSUS_RADIUS, CENSUS_RADIUS) {
                        let u = (x + dx).saturating_sub(CENSUS_RADIUS).min(last_x);
                        bits = (bits << 1) | u64::from(at(u, v) < middle);
                    }
                }
            }
            *descriptor = bits;
        }
    }
}

/// Averages 2x2 pixels; an odd last column or row is dropped.
pub fn halve(luma: &[u8], size: MapImageSize, out: &mut [u8]) -> MapImageSize {
    let half = MapImageSize { width: size.width / 2, height: size.height / 2 };
    for (y, row) in out.chunks_exact_mut(half.width.max(1)).enumerate().take(half.height) {
        for (x, value) in row.iter_mut().enumerate() {
            let at = |dx: usize, dy: usize| {
                u16::from(luma.get((2 * y + dy) * size.width + 2 * x + dx).copied().unwrap_or(0))
            };
            *value = ((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4) as u8;
        }
    }
    half
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec;

    const SIZE: MapImageSize = MapImageSize { width: 9, height: 8 };

    fn described(luma: &[u8]) -> Vec<u64> {
        let mut descriptors = std::vec![0; luma.len()];
        census(luma, SIZE, &mut descriptors);
        descriptors
    }

    #[test]
    fn descriptors_ignore_brightness_and_contrast_but_not_order() {
        let image: Vec<u8> = (0..72u32).map(|i| ((i * 37) % 61) as u8).collect();
        let brighter: Vec<u8> = image.iter().map(|v| v * 2 + 50).collect();
        assert_eq!(described(&image), described(&brighter));
        let mirrored: Vec<u8> = image.chunks(9).flat_map(|row| row.iter().rev().copied()).collect();
        assert_ne!(described(&image), described(&mirrored));
        assert!(described(&image).iter().all(|d| d >> CENSUS_BITS == 0));
        assert!(described(&[5; 72]).iter().all(|&d| d == 0));
    }

    #[test]
    fn half_an_image_is_the_mean_of_its_quads() {
        let mut out = [0; 2];
        let half =
            halve(&[0, 4, 10, 10, 99, 8, 0, 10, 10, 99, 1, 1, 1, 1, 1], MapImageSize { width: 5, height: 3 }, &mut out);
        assert_eq!((half, out), (MapImageSize { width: 2, height: 1 }, [3, 10]));
    }
}
