use super::*;
use crate::features::lanes::Plain;
use crate::features::testing::{Scene, distance};
use std::vec;
use std::vec::Vec;

const SETTINGS: CornerSettings = CornerSettings { cell_px: 200.0, ..CornerSettings::STANDARD };

fn detected(
    pixels: &[u8],
    width: usize,
    settings: &CornerSettings,
    existing_px: &[[f32; 2]],
    capacity: usize,
) -> (Vec<Corner>, CornerReport) {
    let image = ImageView::new(pixels, width, pixels.len() / width, width).expect("sized");
    let mut corners = vec![Corner::NONE; capacity];
    let report = detect(SimdLevel::new(), image, settings, existing_px.iter().copied(), &mut corners);
    corners.truncate(report.n_found);
    (corners, report)
}

/// Dark image with a bright square whose corners are the only corners.
fn square(width: usize, height: usize, [left, top, right, bottom]: [usize; 4]) -> Vec<u8> {
    let inside = |i: usize| (left..right).contains(&(i % width)) && (top..bottom).contains(&(i / width));
    (0..width * height).map(|i| if inside(i) { 200 } else { 20 }).collect()
}

#[test]
fn the_corners_of_a_square_are_found_where_they_are() {
    let pixels = square(96, 96, [30, 34, 62, 70]);
    let settings = CornerSettings { cell_px: 310.0, ..SETTINGS };
    let (corners, _) = detected(&pixels, 96, &settings, &[], 50);
    for expected in [[30.0, 34.0], [62.0, 34.0], [30.0, 70.0], [62.0, 70.0]] {
        let nearest_px = corners.iter().map(|c| distance(c.pixel, expected)).fold(f32::INFINITY, f32::min);
        assert!(nearest_px < 2.5, "{expected:?}: {nearest_px} px, {corners:?}");
    }
    assert_eq!(corners.len(), 4, "edges are no corners: {corners:?}");
}

#[test]
fn responses_of_a_cell_equal_the_plain_formula() {
    let scene = Scene::textured(64, 64);
    let pixels = scene.image([0.0, 0.0]);
    let image = ImageView::new(&pixels, 64, 64, 64).expect("sized");
    let gradient = |x: usize, y: usize| {
        let p = |dx: isize, dy: isize| f64::from(pixels[(y.wrapping_add_signed(dy)) * 64 + x.wrapping_add_signed(dx)]);
        let column = |dx| p(dx, -1) + 2.0 * p(dx, 0) + p(dx, 1);
        let row = |dy| p(-1, dy) + 2.0 * p(0, dy) + p(1, dy);
        [(column(1) - column(-1)) / 8.0, (row(1) - row(-1)) / 8.0]
    };
    let corner = strongest_in_cell::<Plain, FEW_LANES>(Plain, image, [20, 12], [44, 40])[0];
    let (cx, cy) = (corner.pixel[0] as usize, corner.pixel[1] as usize);
    let mut sums = [0.0; 3];
    for y in cy - 2..=cy + 2 {
        for x in cx - 2..=cx + 2 {
            let [gx, gy] = gradient(x, y);
            sums = [sums[0] + gx * gx / 25.0, sums[1] + gx * gy / 25.0, sums[2] + gy * gy / 25.0];
        }
    }
    let [xx, xy, yy] = sums;
    let expected = 0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
    assert!(expected > 1.0, "the scene has corners: {expected}");
    assert!((f64::from(corner.min_eigenvalue) - expected).abs() < 1e-3 * expected, "{corner:?} {expected}");
}

#[test]
fn new_corners_keep_away_from_tracks_and_from_each_other() {
    let pixels = Scene::textured(200, 160).image([0.0, 0.0]);
    let (first, report) = detected(&pixels, 200, &SETTINGS, &[], 500);
    assert!(first.len() > 10 && report.n_refused == 0, "{report:?}");
    let existing_px: Vec<[f32; 2]> = first.iter().step_by(2).map(|corner| corner.pixel).collect();
    let (second, _) = detected(&pixels, 200, &SETTINGS, &existing_px, 500);
    let all: Vec<[f32; 2]> = existing_px.iter().copied().chain(second.iter().map(|c| c.pixel)).collect();
    for (i, a) in all.iter().enumerate() {
        for b in &all[..i] {
            assert!(distance(*a, *b) >= SETTINGS.min_distance_px, "{a:?} {b:?}");
        }
    }
    let unknown = [[f32::NAN, 3.0], [f32::INFINITY, -1.0], [-7.0, 1e30]];
    assert_eq!(detected(&pixels, 200, &SETTINGS, &unknown, 500).0, first, "no numbers are no tracks");
}

#[test]
fn a_full_output_keeps_the_strongest_in_raster_order() {
    let pixels = Scene::textured(200, 160).image([0.0, 0.0]);
    let (all, _) = detected(&pixels, 200, &SETTINGS, &[], 500);
    let (few, report) = detected(&pixels, 200, &SETTINGS, &[], 5);
    assert_eq!((few.len(), report.n_refused), (5, all.len() - 5));
    let mut by_strength = all.clone();
    by_strength.sort_by(|a, b| b.min_eigenvalue.total_cmp(&a.min_eigenvalue));
    let expected: Vec<Corner> = all.into_iter().filter(|corner| by_strength[..5].contains(corner)).collect();
    assert_eq!(few, expected);
    assert_eq!(detected(&pixels, 200, &SETTINGS, &[], 0).0, []);
}

#[test]
fn flat_and_tiny_images_have_no_corners() {
    for (width, height) in [(200, 160), (1, 1), (9, 9), (64, 4)] {
        let (corners, _) = detected(&vec![77; width * height], width, &SETTINGS, &[], 10);
        assert_eq!(corners, [], "{width} x {height}");
    }
}

#[test]
fn every_simd_level_gives_the_same_bits() {
    let pixels = Scene::textured(200, 160).image([0.0, 0.0]);
    let image = ImageView::new(&pixels, 200, 160, 200).expect("sized");
    let run = |simd| {
        let mut corners = [Corner::NONE; 200];
        let report = detect(simd, image, &SETTINGS, core::iter::empty(), &mut corners);
        (report, corners)
    };
    assert_eq!(run(SimdLevel::Scalar), run(SimdLevel::new()));
}
