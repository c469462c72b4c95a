//! Depth by spreading triangulated points: what is known before a second picture helps.

use super::{DepthImage, DepthRequest, road_inverse_depth};

/// How far a point speaks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SparseSettings {
    /// Standard deviation of a point's influence, px at mapping resolution, above 0.
    pub reach_px: f64,
    /// Difference of brightness at which the influence falls to 60 %, grey levels, above 0.
    pub tolerance_grey: f64,
    /// Summed influence at which a pixel is wholly sure, above 0.
    pub full_support: f64,
    /// Confidence of the road plane below the horizon, [0, 1].
    pub road_confidence: f32,
    /// The road is believed up to this distance, m.
    pub road_reach_m: f64,
}

impl SparseSettings {
    /// The values that the shipped maps were measured with.
    pub const MEASURED: Self =
        Self { reach_px: 8.0, tolerance_grey: 20.0, full_support: 1.0, road_confidence: 0.4, road_reach_m: 40.0 };
}

/// Influence ends here, in standard deviations.
const REACH_SIGMAS: f64 = 2.5;
/// Weighted support below which a pixel stays unknown.
const MIN_SUPPORT: f32 = 0.05;

/// Normalised convolution of the points' inverse depths, weighted by distance, likeness of brightness and certainty;
/// pixels no point reaches take the road below the horizon, and stay unknown elsewhere.
///
/// # Source
/// Knutsson & Westin 1993 (normalised convolution); Tomasi & Manduchi 1998 (weights across edges).
pub fn estimate(request: &DepthRequest<'_>, settings: &SparseSettings, out: DepthImage<'_>) {
    let size = request.size();
    let DepthImage { inverse_depth, confidence } = out;
    inverse_depth.fill(0.0);
    confidence.fill(0.0);
    let reach = libm::ceil(REACH_SIGMAS * settings.reach_px) as isize;
    let luma_at = |x: usize, y: usize| request.luma.get(y * size.width + x).copied().map_or(0.0, f64::from);
    for point in request.points.iter().filter(|p| p.depth_m > 0.0) {
        let [px, py] = request.map_pixel(point);
        if !(px >= 0.0 && py >= 0.0 && px < size.width as f64 && py < size.height as f64) {
            continue;
        }
        let (center_x, center_y) = (px as usize, py as usize);
        let own_luma = luma_at(center_x, center_y);
        let certainty = 1.0 / (1.0 + 100.0 * f64::from(point.relative_sigma * point.relative_sigma));
        for dy in -reach..=reach {
            for dx in -reach..=reach {
                let x = center_x.checked_add_signed(dx).filter(|&x| x < size.width);
                let y = center_y.checked_add_signed(dy).filter(|&y| y < size.height);
                let (Some(x), Some(y)) = (x, y) else { continue };
                let far = (dx * dx + dy * dy) as f64 / (settings.reach_px * settings.reach_px);
                let unlike = (luma_at(x, y) - own_luma) / settings.tolerance_grey;
                let weight = (certainty * libm::exp(-0.5 * (far + unlike * unlike))) as f32;
                let index = y * size.width + x;
                if let (Some(sum), Some(weights)) = (inverse_depth.get_mut(index), confidence.get_mut(index)) {
                    *sum += weight / point.depth_m;
                    *weights += weight;
                }
            }
        }
    }
    for (index, (depth, sure)) in inverse_depth.iter_mut().zip(confidence.iter_mut()).enumerate() {
        let support = *sure;
        if support >= MIN_SUPPORT {
            *depth /= support;
            *sure = (support / settings.full_support as f32).min(1.0);
            continue;
        }
        let pixel = [(index % size.width) as f64 + 0.5, (index / size.width) as f64 + 0.5];
        let road = request.road.map_or(0.0, |road| road_inverse_depth(&road, &request.camera, pixel));
        let is_road = road * settings.road_reach_m > 1.0;
        *depth = if is_road { road as f32 } else { 0.0 };
        *sure = if is_road { settings.road_confidence } else { 0.0 };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pinhole;
    use crate::conventions::Rigid;
    use crate::tracking::{KeyframePoint, RoadPlane};

    const CAMERA: Pinhole = Pinhole { width: 60, height: 40, fx: 40.0, fy: 40.0, cx: 30.0, cy: 20.0 };

    fn check(points: &[KeyframePoint], luma: &[u8], expected: &[(usize, usize, Option<f32>)]) {
        let request = DepthRequest {
            camera: CAMERA,
            luma,
            world_from_camera: Rigid::identity(),
            earlier: &[],
            points,
            native_per_map_px: [2.0, 2.0],
            road: Some(RoadPlane { normal_in_camera: [0.0, 1.0, 0.0], height_m: 1.5 }),
        };
        let (mut inverse_depth, mut confidence) = (std::vec![9.0; 2400], std::vec![9.0; 2400]);
        let out = DepthImage { inverse_depth: &mut inverse_depth, confidence: &mut confidence };
        estimate(&request, &SparseSettings::MEASURED, out);
        for &(x, y, depth_m) in expected {
            let (found, sure) = (inverse_depth[y * 60 + x], confidence[y * 60 + x]);
            match depth_m {
                None => assert_eq!((found, sure), (0.0, 0.0), "({x}, {y})"),
                Some(depth_m) => assert!((found * depth_m - 1.0).abs() < 0.02 && sure > 0.0, "({x}, {y}): {found}"),
            }
        }
    }

    fn point(x_native: f32, y_native: f32, depth_m: f32) -> KeyframePoint {
        KeyframePoint { pixel: [x_native, y_native], depth_m, relative_sigma: 0.01 }
    }

    #[test]
    fn a_point_speaks_for_its_neighbourhood_the_road_for_itself_and_nobody_for_the_sky() {
        let grey = [100; 2400];
        check(&[point(20.0, 20.0, 8.0)], &grey, &[(10, 10, Some(8.0)), (14, 8, Some(8.0)), (50, 5, None)]);
        check(&[], &grey, &[(30, 35, Some(60.0 / 15.5)), (30, 19, None), (30, 20, None)]);
        check(&[point(-3.0, 5.0, 8.0), point(500.0, 5.0, 8.0), point(20.0, 20.0, -1.0)], &grey, &[(10, 10, None)]);
    }

    #[test]
    fn a_point_does_not_speak_across_an_edge() {
        let halves: std::vec::Vec<u8> = (0..2400).map(|i| if i % 60 < 20 { 20 } else { 220 }).collect();
        check(&[point(36.0, 20.0, 8.0)], &halves, &[(17, 10, Some(8.0)), (22, 10, None)]);
    }
}
