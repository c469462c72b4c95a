//! Images of a real lens, read as an ideal camera would have taken them.

use super::{Lens, LensFolds, Pinhole};
use core::fmt;
use nalgebra::Vector2;

/// Where a pixel of the rectified image comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SourcePixel {
    /// Index of the upper left of four neighbours in the image of the lens.
    first: u32,
    /// How far right and down of it, in units of 2^-[`WEIGHT_BITS`].
    weights: [u16; 2],
}

/// Fractional bits of a weight: two of them and a grey value fit 32 bits.
const WEIGHT_BITS: u32 = 11;
const ONE: u32 = 1 << WEIGHT_BITS;

/// Ratio of neighbouring focal lengths that are tried.
const ZOOM_STEP: f64 = 1.01;
/// Largest ratio of the ideal camera's focal length to the real one's.
const MAX_ZOOM: f64 = 3.0;

/// How far outside a pixel may come out without lying there, px.
const ROUNDING_PX: f64 = 1e-6;

/// Why there is no ideal camera for a lens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum NoIdealCamera {
    /// The lens is not monotonic within the image; see [`LensFolds`].
    Folds(LensFolds),
    /// Even zoomed in by the largest factor, corners of the ideal image would see nothing: the coefficients belong to
    /// another camera or image size.
    SeesTooLittle,
}

impl fmt::Display for NoIdealCamera {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Folds(fold) => fold.fmt(f),
            Self::SeesTooLittle => write!(f, "the lens model leaves the corners of the rectified image empty"),
        }
    }
}

impl core::error::Error for NoIdealCamera {}

/// The ideal camera at the same place whose every pixel the lens shows: same size and principal point, and the focal
/// lengths of `seen`, or the shortest longer ones that leave no pixel empty. (An empty border would be full of corners
/// that stand still.)
///
/// # Errors
/// [`NoIdealCamera`] says what is wrong with the lens.
pub fn ideal_camera(lens: &Lens, seen: &Pinhole) -> Result<Pinhole, NoIdealCamera> {
    if *lens == Lens::Pinhole {
        return Ok(*seen);
    }
    let mut zoom = 1.0;
    while zoom <= MAX_ZOOM {
        let ideal = Pinhole { fx: seen.fx * zoom, fy: seen.fy * zoom, ..*seen };
        if border(&ideal).all(|pixel| is_shown(lens, seen, &ideal, &pixel)) {
            return lens.check_within(&ideal).map(|()| ideal).map_err(NoIdealCamera::Folds);
        }
        zoom *= ZOOM_STEP;
    }
    // What folds leaves corners empty, too, but is the cause.
    lens.check_within(seen).map_err(NoIdealCamera::Folds)?;
    Err(NoIdealCamera::SeesTooLittle)
}

/// Centres of the pixels along the border.
fn border(camera: &Pinhole) -> impl Iterator<Item = Vector2<f64>> {
    let (width, height) = (camera.width, camera.height);
    let center = |x: u32, y: u32| Vector2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
    let rows = (0..width).flat_map(move |x| [center(x, 0), center(x, height.saturating_sub(1))]);
    rows.chain((0..height).flat_map(move |y| [center(0, y), center(width.saturating_sub(1), y)]))
}

/// Where the lens shows a pixel of the ideal image, px.
fn seen_px(lens: &Lens, seen: &Pinhole, ideal: &Pinhole, pixel: &Vector2<f64>) -> Vector2<f64> {
    let z1 = lens.distort(&ideal.unproject_z1(pixel));
    Vector2::new(seen.fx * z1.x + seen.cx, seen.fy * z1.y + seen.cy)
}

/// Whether all four neighbours that the pixel is interpolated from are in the image.
fn is_shown(lens: &Lens, seen: &Pinhole, ideal: &Pinhole, pixel: &Vector2<f64>) -> bool {
    let at = seen_px(lens, seen, ideal, pixel);
    let within = |c: f64, size: u32| c >= 0.5 - ROUNDING_PX && c <= f64::from(size) - 0.5 + ROUNDING_PX;
    within(at.x, seen.width) && within(at.y, seen.height)
}

/// Fills the table of an image: where each pixel of the `ideal` camera comes from.
///
/// `table` has one entry per pixel, row by row; entries beyond are left alone.
pub fn fill_table(lens: &Lens, seen: &Pinhole, ideal: &Pinhole, table: &mut [SourcePixel]) {
    let width = ideal.width as usize;
    for (i, entry) in table.iter_mut().enumerate().take(width * ideal.height as usize) {
        let pixel = Vector2::new((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let at = seen_px(lens, seen, ideal, &pixel);
        let ((x, right), (y, down)) = (split(at.x, seen.width), split(at.y, seen.height));
        *entry = SourcePixel { first: y * seen.width + x, weights: [right, down] };
    }
}

/// The first of two neighbours that enclose a coordinate, clamped to the image, and the weight of the second.
fn split(coordinate_px: f64, size: u32) -> (u32, u16) {
    let from_first_center = (coordinate_px - 0.5).clamp(0.0, f64::from(size.saturating_sub(1)));
    let first = (from_first_center as u32).min(size.saturating_sub(2));
    (first, libm::round((from_first_center - f64::from(first)) * f64::from(ONE)) as u16)
}

/// Interpolates the rectified image bilinearly from that of the lens.
///
/// # Inputs
/// * `table`: filled by [`fill_table`] for images of this size.
/// * `source`: `CHANNELS` bytes per pixel, `width` pixels per row, without padding; at least two rows and columns.
///
/// # Output
/// `rectified`, as long as the table says; a pixel whose source is missing is left as it was.
///
/// # Cost
/// Four reads and three blends per pixel and channel; no allocation.
pub fn rectify<const CHANNELS: usize>(table: &[SourcePixel], width: usize, source: &[u8], rectified: &mut [u8]) {
    let (pixels, _) = rectified.as_chunks_mut::<CHANNELS>();
    for (pixel, entry) in pixels.iter_mut().zip(table) {
        let upper = entry.first as usize * CHANNELS;
        let pair = |start: usize| Some(source.get(start..)?.get(..2 * CHANNELS)?.split_at(CHANNELS));
        let (Some((a, b)), Some((c, d))) = (pair(upper), pair(upper + width * CHANNELS)) else { continue };
        let [right, down] = entry.weights.map(u32::from);
        for (k, value) in pixel.iter_mut().enumerate() {
            let blend = |left: &[u8], other: &[u8]| u32::from(left[k]) * (ONE - right) + u32::from(other[k]) * right;
            let sum = blend(a, b) * (ONE - down) + blend(c, d) * down;
            *value = ((sum + ONE * ONE / 2) >> (2 * WEIGHT_BITS)) as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;
    use std::vec::Vec;

    const SEEN: Pinhole = Pinhole { width: 120, height: 80, fx: 90.0, fy: 92.0, cx: 61.0, cy: 38.5 };
    const BARREL: Lens = Lens::RadialTangential([-0.28, 0.07, 0.0002, -0.0005, 0.0]);
    const PINCUSHION: Lens = Lens::RadialTangential([0.15, 0.02, -0.0004, 0.0003, 0.0]);
    const FISHEYE: Lens = Lens::KannalaBrandt([0.012, -0.004, 0.0007, -0.0003]);

    /// What stands in the direction of a ray: smooth, so that interpolation follows it.
    fn scenery(z1: &Vector2<f64>, channel: usize) -> f64 {
        let k = channel as f64;
        128.0 + 60.0 * libm::sin(4.0 * z1.x + k) + 50.0 * libm::cos(5.0 * z1.y - k)
    }

    fn picture<const CHANNELS: usize>(ray: impl Fn(&Vector2<f64>) -> Option<Vector2<f64>>) -> Vec<u8> {
        let mut bytes = Vec::new();
        for i in 0..(SEEN.width * SEEN.height) {
            let pixel = Vector2::new(f64::from(i % SEEN.width) + 0.5, f64::from(i / SEEN.width) + 0.5);
            let value = |channel| ray(&pixel).map_or(0.0, |z1| libm::round(scenery(&z1, channel)));
            bytes.extend((0..CHANNELS).map(|channel| value(channel) as u8));
        }
        bytes
    }

    fn check<const CHANNELS: usize>(lens: Lens) {
        let ideal = ideal_camera(&lens, &SEEN).expect("a good lens");
        let photo = picture::<CHANNELS>(|pixel| lens.undistort(&SEEN.unproject_z1(pixel)));
        let expected = picture::<CHANNELS>(|pixel| Some(ideal.unproject_z1(pixel)));
        let mut table = vec![SourcePixel::default(); (SEEN.width * SEEN.height) as usize];
        fill_table(&lens, &SEEN, &ideal, &mut table);
        let mut rectified = vec![0; photo.len()];
        rectify::<CHANNELS>(&table, SEEN.width as usize, &photo, &mut rectified);
        let worst = rectified.iter().zip(&expected).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(worst <= Some(1), "{lens:?}: off by {worst:?} grey values");
        assert!(photo.iter().zip(&expected).any(|(a, b)| a.abs_diff(*b) > 3), "{lens:?} bends nothing");
    }

    #[test]
    fn a_photo_comes_out_as_an_ideal_camera_would_have_taken_it() {
        check::<1>(BARREL);
        check::<3>(BARREL);
        check::<1>(PINCUSHION);
        check::<3>(FISHEYE);
    }

    #[test]
    fn a_lens_without_distortion_changes_no_byte() {
        let lens = Lens::RadialTangential([0.0; 5]);
        assert_eq!(ideal_camera(&lens, &SEEN), Ok(SEEN));
        assert_eq!(ideal_camera(&Lens::Pinhole, &SEEN), Ok(SEEN));
        let photo: Vec<u8> = (0..SEEN.width * SEEN.height).map(|i| (i * 37 % 251) as u8).collect();
        let mut table = vec![SourcePixel::default(); photo.len()];
        fill_table(&lens, &SEEN, &SEEN, &mut table);
        let mut rectified = vec![0; photo.len()];
        rectify::<1>(&table, SEEN.width as usize, &photo, &mut rectified);
        assert_eq!(rectified, photo);
    }

    #[test]
    fn the_ideal_camera_sees_only_what_the_lens_shows() {
        let of = |lens| ideal_camera(&lens, &SEEN);
        assert_eq!(of(BARREL), Ok(SEEN), "a barrel shows more than the ideal camera");
        let zoomed = of(PINCUSHION).expect("a good lens");
        assert!(zoomed.fx > 1.02 * SEEN.fx && zoomed.fx / SEEN.fx == zoomed.fy / SEEN.fy, "{zoomed:?}");
        let folds = of(Lens::RadialTangential([-1.5, 0.0, 0.0, 0.0, 0.0]));
        assert!(matches!(folds, Err(NoIdealCamera::Folds(_))), "{folds:?}");
        let too_little = of(Lens::RadialTangential([0.0, 0.0, 0.0, 0.0, 1e4]));
        assert_eq!(too_little, Err(NoIdealCamera::SeesTooLittle));
    }

    #[test]
    fn missing_rows_leave_their_pixels_alone() {
        let mut table = [SourcePixel::default(); 4];
        fill_table(&Lens::Pinhole, &Pinhole { width: 2, height: 2, ..SEEN }, &SEEN, &mut table);
        let mut rectified = [7; 4];
        rectify::<1>(&table, 2, &[1, 2, 3], &mut rectified);
        assert_eq!(rectified, [7; 4]);
    }
}
