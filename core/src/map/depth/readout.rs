//! From aggregated costs to a depth that is believed: cheapest label, outliers, sky, full size.

use super::DepthImage;
use super::census::CENSUS_BITS;
use super::motion_stereo::StereoSettings;
use super::sweep::N_LABELS;
use crate::map::insertion::MapImageSize;

/// Takes the cheapest label, between labels by a parabola; confident where the pictures agree there.
pub fn cheapest(
    settings: &StereoSettings,
    labels: &[f32; N_LABELS],
    cost: &[u8],
    total: &[u16],
    inverse_depth: &mut [f32],
    confidence: &mut [f32],
) {
    let pixels = cost.chunks_exact(N_LABELS).zip(total.chunks_exact(N_LABELS));
    for ((costs, totals), (depth, sure)) in pixels.zip(inverse_depth.iter_mut().zip(confidence.iter_mut())) {
        let best = (0..N_LABELS).min_by_key(|&label| totals.get(label).copied()).unwrap_or(0);
        let total_at = |label: usize| totals.get(label).copied().map_or(0.0, f32::from);
        let label_at = |label: usize| labels.get(label).copied().unwrap_or(0.0);
        *depth = label_at(best);
        if best > 0 && best + 1 < N_LABELS {
            let (before, here, after) = (total_at(best - 1), total_at(best), total_at(best + 1));
            let curvature = before + after - 2.0 * here;
            let shift = if curvature > 0.0 { (0.5 * (before - after) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
            let step =
                if shift < 0.0 { label_at(best) - label_at(best - 1) } else { label_at(best + 1) - label_at(best) };
            *depth += shift * step;
        }
        let distance = costs.get(best).copied().map_or(CENSUS_BITS as f32, f32::from);
        *sure = (1.0 - distance / f32::from(settings.max_distance)).max(0.0);
    }
}

/// Half side of the windows of [`settle`], px.
const WINDOW_RADIUS: usize = 2;
/// Relative difference of inverse depth within which two pixels agree.
const AGREEMENT_RATIO: f32 = 0.15;
/// Confidence of a textured surface that is too far to be measured.
const FAR_CONFIDENCE: f32 = 0.3;

/// Replaces each inverse depth by the median of its 3x3 neighbourhood (`filtered`), lowers the confidence where the
/// neighbours disagree, puts what is too far at the farthest distance, and leaves the sky to the background: plain,
/// brighter than the picture's mean, and reaching up to its upper border.
pub fn settle(
    settings: &StereoSettings,
    luma: &[u8],
    size: MapImageSize,
    inverse_depth: &[f32],
    confidence: &mut [f32],
    filtered: &mut [f32],
) {
    let MapImageSize { width, height } = size;
    let mean_luma = luma.iter().map(|&v| u64::from(v)).sum::<u64>() / luma.len().max(1) as u64;
    let farthest = 1.0 / settings.farthest_m;
    for y in 0..height {
        for x in 0..width {
            let index = y * width + x;
            let median = median_of_nine(inverse_depth, size, x, y);
            let (agreeing, contrast) = look_around(inverse_depth, luma, size, (x, y), median);
            let is_plain = contrast < settings.plain_grey;
            let is_bright = luma.get(index).is_some_and(|&v| u64::from(v) > mean_luma);
            // The sky is written as a depth of zero; above it there is more sky or the border.
            let above = |dx: isize| {
                let x = x.checked_add_signed(dx).filter(|&x| x < width);
                x.and_then(|x| filtered.get((y - 1) * width + x)) == Some(&0.0)
            };
            let is_sky = is_plain && is_bright && (y == 0 || [-1, 0, 1].into_iter().any(above));
            let (Some(depth), Some(sure)) = (filtered.get_mut(index), confidence.get_mut(index)) else { continue };
            if is_sky {
                (*depth, *sure) = (0.0, 0.0);
            } else if median < farthest {
                (*depth, *sure) = (farthest, if is_plain { 0.0 } else { FAR_CONFIDENCE });
            } else {
                *depth = median;
                *sure *= agreeing;
            }
        }
    }
}

fn median_of_nine(values: &[f32], size: MapImageSize, x: usize, y: usize) -> f32 {
    let mut window = [0.0f32; 9];
    for (slot, value) in window.iter_mut().enumerate() {
        let u = (x + slot % 3).saturating_sub(1).min(size.width - 1);
        let v = (y + slot / 3).saturating_sub(1).min(size.height - 1);
        *value = values.get(v * size.width + u).copied().unwrap_or(0.0);
    }
    window.sort_unstable_by(f32::total_cmp);
    window[4]
}

/// Share of the window whose inverse depth agrees with `median`, and the window's range of brightness.
fn look_around(
    inverse_depth: &[f32],
    luma: &[u8],
    size: MapImageSize,
    (x, y): (usize, usize),
    median: f32,
) -> (f32, u8) {
    let (mut n_agreeing, mut n_pixels, mut darkest, mut brightest) = (0u32, 0u32, u8::MAX, 0u8);
    for v in y.saturating_sub(WINDOW_RADIUS)..(y + WINDOW_RADIUS + 1).min(size.height) {
        for u in x.saturating_sub(WINDOW_RADIUS)..(x + WINDOW_RADIUS + 1).min(size.width) {
            let index = v * size.width + u;
            let (Some(&depth), Some(&grey)) = (inverse_depth.get(index), luma.get(index)) else { continue };
            n_pixels += 1;
            n_agreeing += u32::from((depth - median).abs() <= AGREEMENT_RATIO * median);
            darkest = darkest.min(grey);
            brightest = brightest.max(grey);
        }
    }
    (n_agreeing as f32 / n_pixels.max(1) as f32, brightest.saturating_sub(darkest))
}

/// Relative difference of inverse depth across which nothing is interpolated.
const MAX_INTERPOLATED_STEP: f32 = 0.1;

/// Brings inverse depth and confidence from half to full mapping resolution; bilinear within a surface, nearest
/// across its edge.
pub fn enlarge(size: MapImageSize, half: MapImageSize, inverse_depth: &[f32], confidence: &[f32], out: DepthImage<'_>) {
    let (last_x, last_y) = (half.width.saturating_sub(1), half.height.saturating_sub(1));
    for (index, (depth, sure)) in out.inverse_depth.iter_mut().zip(out.confidence.iter_mut()).enumerate() {
        let (x, y) = (index % size.width, index / size.width);
        let (near_x, near_y) = ((x / 2).min(last_x), (y / 2).min(last_y));
        // A full-resolution centre lies a quarter of a half-resolution pixel from the nearest one.
        let side =
            |even: bool, near: usize, last: usize| if even { near.saturating_sub(1) } else { (near + 1).min(last) };
        let (far_x, far_y) = (side(x % 2 == 0, near_x, last_x), side(y % 2 == 0, near_y, last_y));
        let at = |x: usize, y: usize| inverse_depth.get(y * half.width + x).copied().unwrap_or(0.0);
        let quad = [at(near_x, near_y), at(far_x, near_y), at(near_x, far_y), at(far_x, far_y)];
        let nearest = quad[0];
        let is_one_surface = quad.iter().all(|value| (value - nearest).abs() <= MAX_INTERPOLATED_STEP * nearest);
        const QUARTER_WEIGHTS: [f32; 4] = [9.0 / 16.0, 3.0 / 16.0, 3.0 / 16.0, 1.0 / 16.0];
        *depth = if is_one_surface { quad.iter().zip(QUARTER_WEIGHTS).map(|(v, w)| v * w).sum() } else { nearest };
        *sure = confidence.get(near_y * half.width + near_x).copied().unwrap_or(0.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec;

    const SIZE: MapImageSize = MapImageSize { width: 8, height: 8 };

    /// Settles a picture that is `luma(x, y)` at inverse depth `w(x, y)`.
    fn settled(luma: impl Fn(usize, usize) -> u8, w: impl Fn(usize, usize) -> f32) -> (vec::Vec<f32>, vec::Vec<f32>) {
        let picture: vec::Vec<u8> = (0..64).map(|i| luma(i % 8, i / 8)).collect();
        let depth: vec::Vec<f32> = (0..64).map(|i| w(i % 8, i / 8)).collect();
        let (mut confidence, mut filtered) = (vec![1.0; 64], vec![9.0; 64]);
        settle(&StereoSettings::MEASURED, &picture, SIZE, &depth, &mut confidence, &mut filtered);
        (filtered, confidence)
    }

    #[test]
    fn one_wrong_pixel_is_outvoted_and_its_neighbourhood_doubted_a_little() {
        let textured = |x: usize, y: usize| ((x * 37 + y * 91) % 200) as u8;
        let (depth, sure) = settled(textured, |x, y| if (x, y) == (4, 4) { 0.9 } else { 0.1 });
        assert!(depth.iter().all(|&w| w == 0.1), "{depth:?}");
        assert!(sure[4 * 8 + 4] == 24.0 / 25.0 && sure[0] == 1.0);
    }

    #[test]
    fn a_plain_bright_top_is_sky_and_a_plain_bright_wall_under_a_roof_is_not() {
        // Rows 0-1 sky, 2-3 a dark speckled roof, 4-7 a wall as bright as the sky.
        let luma = |x: usize, y: usize| if (2..4).contains(&y) { (x * 20 % 50) as u8 } else { 230 };
        let tall = |y: usize| if y < 2 { 0.02 } else { 0.1 };
        let (depth, sure) = settled(luma, |_, y| tall(y));
        // The window reaches two rows, so no row of this small sky is plain; a taller one is.
        assert!(sure[7 * 8] > 0.0 && depth[7 * 8] == 0.1);
        let (depth, sure) = settled(|x, y| if y < 5 { 230 } else { (x * 20 % 50) as u8 }, |_, _| 0.05);
        assert_eq!((depth[8 + 3], sure[8 + 3]), (0.0, 0.0));
        assert_eq!(depth[7 * 8 + 3], 0.05);
    }

    #[test]
    fn a_textured_surface_too_far_to_measure_goes_to_the_farthest_distance() {
        let (depth, sure) = settled(|x, y| ((x * 37 + y * 91) % 200) as u8, |_, _| 0.0);
        assert!(depth.iter().all(|&w| w == 1.0 / StereoSettings::MEASURED.farthest_m));
        assert!(sure.iter().all(|&c| c == FAR_CONFIDENCE));
    }

    #[test]
    fn enlarging_keeps_planes_straight_and_edges_sharp() {
        let half = MapImageSize { width: 4, height: 1 };
        let size = MapImageSize { width: 8, height: 2 };
        let (mut inverse_depth, mut confidence) = (vec![0.0; 16], vec![0.0; 16]);
        let out = DepthImage { inverse_depth: &mut inverse_depth, confidence: &mut confidence };
        enlarge(size, half, &[1.00, 1.04, 1.08, 0.2], &[1.0, 1.0, 0.5, 0.0], out);
        for (x, expected) in [(1, 1.01), (2, 1.03), (3, 1.05), (5, 1.08), (6, 0.2), (7, 0.2)] {
            assert!((inverse_depth[x] - expected).abs() < 1e-5, "{inverse_depth:?}");
        }
        assert_eq!(confidence[..8], [1.0, 1.0, 1.0, 1.0, 0.5, 0.5, 0.0, 0.0]);
    }
}
