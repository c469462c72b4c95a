//! Depth by motion stereo: the keyframe against its predecessors, with road and triangulated points as hints.

use super::aggregate::{self, Penalties};
use super::census;
use super::sweep::{self, N_LABELS, SweepSource};
use super::{DepthImage, DepthRequest, EarlierView, readout, road_inverse_depth};
use crate::camera::Pinhole;
use crate::map::insertion::MapImageSize;

/// Earlier keyframes that are compared at most.
pub const MAX_SOURCES: usize = 3;

/// What decides whether a depth is believed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StereoSettings {
    /// Depth of the nearest surface that is looked for, m, above 0.
    pub nearest_m: f32,
    /// Surfaces that seem farther than this are put here, m: their true distance cannot be told.
    pub farthest_m: f32,
    /// Difference of brightness within five pixels below which the picture is plain, grey levels.
    pub plain_grey: u8,
    /// Shortest way between two keyframes that tells a depth, m.
    pub min_baseline_m: f64,
    /// Smoothness of the depth.
    pub penalties: Penalties,
    /// Census bits by which the road's own depth is preferred on the road.
    pub road_bonus: u8,
    /// Census bits that a depth below the road costs.
    pub below_road_penalty: u8,
    /// Census bits that a depth other than that of a triangulated point costs at the point.
    pub point_penalty: u8,
    /// Census distance at which a depth is no longer believed, bits; confidence falls linearly up to there.
    pub max_distance: u8,
}

impl StereoSettings {
    /// The values that the shipped maps were measured with.
    pub const MEASURED: Self = Self {
        nearest_m: 3.5,
        farthest_m: 220.0,
        plain_grey: 12,
        min_baseline_m: 0.3,
        penalties: Penalties { slant: 6, jump: 64, half_at_difference: 12 },
        road_bonus: 4,
        below_road_penalty: 16,
        point_penalty: 10,
        max_distance: 26,
    };
}

/// Memory of [`estimate`] for images of `n` pixels at half the mapping resolution.
#[derive(Debug)]
pub struct StereoMemory<'m> {
    /// `n`: the keyframe's brightness.
    pub luma: &'m mut [u8],
    /// `n`: an earlier keyframe's brightness.
    pub source_luma: &'m mut [u8],
    /// `n`: the keyframe's descriptors.
    pub census: &'m mut [u64],
    /// `n * MAX_SOURCES`: the earlier keyframes' descriptors.
    pub source_census: &'m mut [u64],
    /// `n * N_LABELS`: cost of every label.
    pub cost: &'m mut [u8],
    /// `n * N_LABELS`: aggregated cost of every label.
    pub total: &'m mut [u16],
    /// [`aggregate::scratch_len`] of the half width.
    pub paths: &'m mut [u16],
    /// `n`: inverse depth at half the mapping resolution, 1/m.
    pub inverse_depth: &'m mut [f32],
    /// `n`: confidence at half the mapping resolution.
    pub confidence: &'m mut [f32],
    /// `n`: inverse depth without its outliers, 1/m.
    pub filtered: &'m mut [f32],
}

/// What the comparison had to go by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct StereoReport {
    /// Earlier keyframes far enough away to compare with.
    pub n_sources: usize,
    /// Pixels with a depth that is believed, at half the mapping resolution.
    pub n_confident: usize,
}

/// Estimates the inverse depth of every pixel; nothing is written when no earlier keyframe is far enough away.
///
/// # Cost
/// O(pixels x labels x (sources + 8)); no allocation.
///
/// # Source
/// Plane sweep with census cost and semi-global aggregation (see the parts); hints are own.
pub fn estimate(
    request: &DepthRequest<'_>,
    settings: &StereoSettings,
    memory: StereoMemory<'_>,
    out: DepthImage<'_>,
) -> StereoReport {
    let half_camera = halved(&request.camera);
    let size = census::halve(request.luma, request.size(), memory.luma);
    census::census(memory.luma, size, memory.census);
    let mut nearest_baseline_m = f64::INFINITY;
    let mut sources: [Option<SweepSource<'_>>; MAX_SOURCES] = [None; MAX_SOURCES];
    let usable = request.earlier.iter().filter(|view| baseline_m(request, view) >= settings.min_baseline_m);
    let slots = sources.iter_mut().zip(memory.source_census.chunks_exact_mut(size.n_pixels().max(1)));
    let mut n_sources = 0;
    for (view, (source, descriptors)) in usable.zip(slots) {
        census::halve(view.luma, request.size(), memory.source_luma);
        census::census(memory.source_luma, size, descriptors);
        let source_from_reference = view.world_from_camera.inverse() * request.world_from_camera;
        *source = Some(SweepSource::new(descriptors, &half_camera, &source_from_reference));
        nearest_baseline_m = nearest_baseline_m.min(baseline_m(request, view));
        n_sources += 1;
    }
    if n_sources == 0 {
        return StereoReport::default();
    }
    let labels = sweep::label_inverse_depths(nearest_baseline_m, 1.0 / f64::from(settings.nearest_m));
    let mut compared = [SweepSource::new(&[], &half_camera, &crate::conventions::Rigid::identity()); MAX_SOURCES];
    for (slot, source) in compared.iter_mut().zip(sources.iter().flatten()) {
        *slot = *source;
    }
    let compared = compared.get(..n_sources).unwrap_or(&[]);
    sweep::sweep(memory.census, compared, size, &labels, memory.cost);
    hint_at_road(request, &half_camera, size, settings, &labels, memory.cost);
    hint_at_points(request, size, settings, &labels, memory.cost);
    aggregate::aggregate(memory.cost, memory.luma, size, &settings.penalties, memory.paths, memory.total);
    readout::cheapest(settings, &labels, memory.cost, memory.total, memory.inverse_depth, memory.confidence);
    readout::settle(settings, memory.luma, size, memory.inverse_depth, memory.confidence, memory.filtered);
    let n_confident = memory.confidence.iter().filter(|sure| **sure > 0.0).count();
    readout::enlarge(request.size(), size, memory.filtered, memory.confidence, out);
    StereoReport { n_sources, n_confident }
}

/// The same camera with pixels twice as large; an odd last column or row is cut off, not squeezed.
fn halved(camera: &Pinhole) -> Pinhole {
    Pinhole {
        width: camera.width / 2,
        height: camera.height / 2,
        fx: camera.fx / 2.0,
        fy: camera.fy / 2.0,
        cx: camera.cx / 2.0,
        cy: camera.cy / 2.0,
    }
}

fn baseline_m(request: &DepthRequest<'_>, view: &EarlierView<'_>) -> f64 {
    (view.world_from_camera.translation.vector - request.world_from_camera.translation.vector).norm()
}

/// Below this share of the road's inverse depth a surface would lie under the road.
const UNDERGROUND_RATIO: f64 = 0.85;

/// On pixels whose ray meets the road: prefers the road's depth and makes depths behind it expensive.
fn hint_at_road(
    request: &DepthRequest<'_>,
    half_camera: &Pinhole,
    size: MapImageSize,
    settings: &StereoSettings,
    labels: &[f32; N_LABELS],
    cost: &mut [u8],
) {
    let Some(road) = &request.road else { return };
    for (index, costs) in cost.chunks_exact_mut(N_LABELS).enumerate().take(size.n_pixels()) {
        let pixel = [(index % size.width) as f64 + 0.5, (index / size.width) as f64 + 0.5];
        let expected = road_inverse_depth(road, half_camera, pixel);
        if expected < 1.0 / f64::from(settings.farthest_m) {
            continue;
        }
        let nearest_label = nearest_label(labels, expected as f32);
        for (label, (value, &inverse_depth)) in costs.iter_mut().zip(labels).enumerate() {
            if label.abs_diff(nearest_label) <= 1 {
                *value = value.saturating_sub(settings.road_bonus);
            } else if f64::from(inverse_depth) < UNDERGROUND_RATIO * expected {
                *value += settings.below_road_penalty;
            }
        }
    }
}

/// Labels next to a point's own that its uncertainty leaves open.
const POINT_TOLERANCE_LABELS: usize = 2;
/// Points less certain than this tell nothing.
const MAX_POINT_SIGMA: f32 = 0.1;

/// At the pixel of a triangulated point, makes depths other than the point's expensive.
fn hint_at_points(
    request: &DepthRequest<'_>,
    size: MapImageSize,
    settings: &StereoSettings,
    labels: &[f32; N_LABELS],
    cost: &mut [u8],
) {
    for point in request.points.iter().filter(|p| p.relative_sigma < MAX_POINT_SIGMA && p.depth_m > 0.0) {
        let [x, y] = request.map_pixel(point).map(|coordinate| coordinate / 2.0);
        if !(x >= 0.0 && y >= 0.0 && x < size.width as f64 && y < size.height as f64) {
            continue;
        }
        let index = y as usize * size.width + x as usize;
        let nearest_label = nearest_label(labels, 1.0 / point.depth_m);
        let Some(costs) = cost.get_mut(index * N_LABELS..(index + 1) * N_LABELS) else { continue };
        for (label, value) in costs.iter_mut().enumerate() {
            if label.abs_diff(nearest_label) > POINT_TOLERANCE_LABELS {
                *value += settings.point_penalty;
            }
        }
    }
}

fn nearest_label(labels: &[f32; N_LABELS], inverse_depth: f32) -> usize {
    let above = labels.partition_point(|&label| label < inverse_depth).min(N_LABELS - 1);
    let at = |label: usize| labels.get(label).copied().unwrap_or(f32::INFINITY);
    let below = above.saturating_sub(1);
    if inverse_depth - at(below) < at(above) - inverse_depth { below } else { above }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conventions::Rigid;
    use crate::math::Rng;
    use crate::tracking::RoadPlane;
    use nalgebra::Vector3;
    use std::vec;
    use std::vec::Vec;

    const CAMERA: Pinhole = Pinhole { width: 320, height: 160, fx: 180.0, fy: 180.0, cx: 160.0, cy: 70.0 };
    const ROAD: RoadPlane = RoadPlane { normal_in_camera: [0.0, 1.0, 0.0], height_m: 1.65 };
    const WALL_M: f64 = 14.0;

    /// Speckle of a plane at two metres' resolution and finer.
    fn speckle(x: f64, y: f64) -> f64 {
        let lattice = |scale: f64, purpose: u64| {
            let cell = |v: f64| libm::floor(v * scale);
            let (fx, fy) = (x * scale - cell(x), y * scale - cell(y));
            let corner = |dx: f64, dy: f64| {
                let key =
                    ((cell(x) + dx) as i64 as u64).wrapping_mul(31) ^ ((cell(y) + dy) as i64 as u64).wrapping_mul(7919);
                f64::from(Rng::new(9, key, purpose).unit_f32())
            };
            (corner(0.0, 0.0) * (1.0 - fx) + corner(1.0, 0.0) * fx) * (1.0 - fy)
                + (corner(0.0, 1.0) * (1.0 - fx) + corner(1.0, 1.0) * fx) * fy
        };
        0.5 * lattice(0.7, 1) + 0.5 * lattice(3.0, 2)
    }

    /// A road under a wall at `WALL_M` from the last camera, seen from `z_m` behind it.
    fn picture(z_m: f64) -> Vec<u8> {
        let n = (CAMERA.width * CAMERA.height) as usize;
        (0..n)
            .map(|i| {
                let ray = ray(i);
                let wall_m = WALL_M + z_m;
                let road_m = if ray.y > 0.0 { ROAD.height_m / ray.y } else { f64::INFINITY };
                let value = if road_m < wall_m {
                    speckle(ray.x * road_m, road_m - z_m)
                } else {
                    speckle(ray.x * wall_m + 100.0, ray.y * wall_m)
                };
                (value * 255.0) as u8
            })
            .collect()
    }

    fn ray(index: usize) -> Vector3<f64> {
        let (x, y) = (index as u32 % CAMERA.width, index as u32 / CAMERA.width);
        Vector3::new((f64::from(x) + 0.5 - CAMERA.cx) / CAMERA.fx, (f64::from(y) + 0.5 - CAMERA.cy) / CAMERA.fy, 1.0)
    }

    fn run(earlier_m: &[f64], road: Option<RoadPlane>) -> (StereoReport, Vec<f32>, Vec<f32>) {
        let n = (CAMERA.width * CAMERA.height) as usize;
        let half = n / 4;
        let luma = picture(0.0);
        let pictures: Vec<Vec<u8>> = earlier_m.iter().map(|&z_m| picture(z_m)).collect();
        let earlier: Vec<EarlierView<'_>> = earlier_m
            .iter()
            .zip(&pictures)
            .map(|(z_m, luma)| EarlierView { luma, world_from_camera: Rigid::translation(0.0, 0.0, -z_m) })
            .collect();
        let request = DepthRequest {
            camera: CAMERA,
            luma: &luma,
            world_from_camera: Rigid::identity(),
            earlier: &earlier,
            points: &[],
            native_per_map_px: [2.0, 2.0],
            road,
        };
        let (mut inverse_depth, mut confidence) = (vec![0.0; n], vec![0.0; n]);
        let memory = StereoMemory {
            luma: &mut vec![0; half],
            source_luma: &mut vec![0; half],
            census: &mut vec![0; half],
            source_census: &mut vec![0; half * MAX_SOURCES],
            cost: &mut vec![0; half * N_LABELS],
            total: &mut vec![0; half * N_LABELS],
            paths: &mut vec![0; aggregate::scratch_len(CAMERA.width as usize / 2)],
            inverse_depth: &mut vec![0.0; half],
            confidence: &mut vec![0.0; half],
            filtered: &mut vec![0.0; half],
        };
        let out = DepthImage { inverse_depth: &mut inverse_depth, confidence: &mut confidence };
        let report = estimate(&request, &StereoSettings::MEASURED, memory, out);
        (report, inverse_depth, confidence)
    }

    /// Share of the confident pixels whose depth is within 15 % of the truth, and the share of confident pixels.
    fn judged(inverse_depth: &[f32], confidence: &[f32]) -> (f64, f64) {
        let truth = |index: usize| (ray(index).y / ROAD.height_m).max(1.0 / WALL_M);
        // Next to where the camera drives to, nothing moves and nothing can be told.
        let moves = |i: usize| ray(i).x.hypot(ray(i).y) > 0.3;
        let sure: Vec<usize> = (0..confidence.len()).filter(|&i| confidence[i] > 0.0 && moves(i)).collect();
        let good = sure.iter().filter(|&&i| (f64::from(inverse_depth[i]) / truth(i) - 1.0).abs() < 0.15).count();
        let n_moving = (0..confidence.len()).filter(|&i| moves(i)).count();
        (good as f64 / sure.len().max(1) as f64, sure.len() as f64 / n_moving as f64)
    }

    #[test]
    fn a_wall_and_a_road_are_measured_from_two_earlier_keyframes() {
        for (earlier_m, road) in [([1.5, 3.0], None), ([5.0, 10.0], Some(ROAD))] {
            let (report, inverse_depth, confidence) = run(&earlier_m, road);
            let (good, covered) = judged(&inverse_depth, &confidence);
            assert_eq!(report.n_sources, 2);
            assert!(good > 0.8 && covered > 0.85, "road {road:?}: {good} good of {covered} covered");
        }
    }

    #[test]
    fn standing_still_tells_nothing() {
        let (report, inverse_depth, confidence) = run(&[0.0, 0.1], Some(ROAD));
        assert_eq!(report, StereoReport::default());
        assert!(inverse_depth.iter().chain(&confidence).all(|&v| v == 0.0));
    }
}
