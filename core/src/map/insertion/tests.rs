//! Where samples fall, and where they do not.

use super::*;
use std::vec;
use std::vec::Vec;

const SIZE: MapImageSize = MapImageSize { width: 60, height: 40 };

/// A dark image with one speckled square, 10 px wide, at (20, 10).
fn square() -> Vec<f32> {
    let mut rng = Rng::new(4, 5, 6);
    (0..SIZE.n_pixels())
        .map(|i| (i % SIZE.width, i / SIZE.width, rng.unit_f32()))
        .map(|(x, y, luck)| if (20..30).contains(&x) && (10..20).contains(&y) { 0.2 + 0.8 * luck } else { 0.1 })
        .collect()
}

fn structure(luma: &[f32]) -> Vec<f32> {
    let (mut scratch, mut out) = (vec![0.0; luma.len()], vec![0.0; luma.len()]);
    find_structure(StructureOperator::DifferenceOfGaussians, (luma, SIZE), [1.0, 1.6], &mut scratch, &mut out);
    out
}

fn drawn(seen: &[f32], rendered: &[f32], transmittance: f32, confidence: &[f32]) -> Vec<InsertionSample> {
    drawn_with(SETTINGS, f32::INFINITY, (seen, rendered), transmittance, confidence)
}

const SETTINGS: InsertionSettings =
    InsertionSettings { bare_probability: 0.2, error_weight: 0.0, ..InsertionSettings::MEASURED };

fn drawn_within(
    most_samples: f32,
    images: (&[f32], &[f32]),
    transmittance: f32,
    confidence: &[f32],
) -> Vec<InsertionSample> {
    drawn_with(SETTINGS, most_samples, images, transmittance, confidence)
}

fn drawn_with(
    settings: InsertionSettings,
    most_samples: f32,
    (seen, rendered): (&[f32], &[f32]),
    transmittance: f32,
    confidence: &[f32],
) -> Vec<InsertionSample> {
    let n = SIZE.n_pixels();
    let (structure, rendered_structure) = (structure(seen), structure(rendered));
    let images = InsertionImages {
        size: SIZE,
        structure: &structure,
        depth_edges: &vec![0.0; n],
        rendered_structure: &rendered_structure,
        rendered_depth_edges: &vec![0.0; n],
        transmittance: &vec![transmittance; n],
        error: &vec![0.0; n],
        confidence,
    };
    let mut samples = vec![InsertionSample::default(); n];
    let scratch = SamplingScratch { probability: &mut vec![0.0; n], kept: &mut vec![0; n] };
    let found = sample(&images, &settings, most_samples, &mut Rng::new(1, 2, 3), scratch, &mut samples);
    samples.truncate(found.n_samples);
    samples
}

#[test]
fn structure_is_zero_on_a_plain_image_up_to_its_borders_and_large_at_an_edge() {
    assert!(structure(&vec![0.7; SIZE.n_pixels()]).iter().all(|v| v.abs() < 1e-6));
    let found = structure(&square());
    let largest = found.iter().copied().fold(0.0, f32::max);
    assert!(largest > 0.05 && found[15 * SIZE.width + 45] < 1e-4, "{largest}");
}

#[test]
fn a_map_that_shows_the_image_asks_for_nothing_and_an_empty_one_for_the_edges() {
    let (image, sure) = (square(), vec![1.0; SIZE.n_pixels()]);
    assert_eq!(drawn(&image, &image, 0.0, &sure), []);
    let edges = drawn(&image, &vec![0.1; SIZE.n_pixels()], 0.0, &sure);
    assert!(edges.len() > 4, "{} samples", edges.len());
    assert!(edges.iter().all(|s| (15..35).contains(&s.x) && (5..25).contains(&s.y)), "{edges:?}");
}

#[test]
fn where_only_what_is_bare_counts_edges_that_the_map_lacks_are_left_out() {
    let (image, plain, sure) = (square(), vec![0.1; SIZE.n_pixels()], vec![1.0; SIZE.n_pixels()]);
    let only_bare = InsertionSettings { only_bare: true, error_weight: 1.0, ..SETTINGS };
    let drawn = |transmittance| drawn_with(only_bare, f32::INFINITY, (&image, &plain), transmittance, &sure);
    assert_eq!(drawn(0.0), []);
    assert!(drawn(1.0).len() > 10, "{} samples", drawn(1.0).len());
}

#[test]
fn bare_pixels_are_covered_evenly_and_more_widely_than_texture() {
    let (image, sure) = (square(), vec![1.0; SIZE.n_pixels()]);
    let all = drawn(&image, &vec![0.1; SIZE.n_pixels()], 1.0, &sure);
    let mean_sigma = |inside: bool| {
        let near = |s: &&InsertionSample| ((18..32).contains(&s.x) && (8..22).contains(&s.y)) == inside;
        let sigmas: Vec<f32> = all.iter().filter(near).map(|s| s.sigma_px).collect();
        (sigmas.len(), sigmas.iter().sum::<f32>() / sigmas.len() as f32)
    };
    let ((n_texture, texture_px), (n_flat, flat_px)) = (mean_sigma(true), mean_sigma(false));
    assert!(n_texture > 5 && n_flat > 20, "{n_texture} and {n_flat} samples");
    assert!(flat_px > 1.2 * texture_px, "{flat_px} px against {texture_px} px");
}

#[test]
fn few_samples_are_spread_over_the_picture_and_cover_it_with_wider_gaussians() {
    let (image, bare, sure) = (square(), vec![0.1; SIZE.n_pixels()], vec![1.0; SIZE.n_pixels()]);
    let mut last_sigma_px = 0.0;
    for most in [f32::INFINITY, 24.0, 12.0, 0.0] {
        let found = drawn_within(most, (&image, &bare), 1.0, &sure);
        let n_wanted = most.min(45.0);
        assert!((found.len() as f32) <= 1.15 * most && found.len() as f32 >= 0.6 * n_wanted, "{}: {most}", found.len());
        if found.is_empty() {
            continue;
        }
        let mean_sigma_px = found.iter().map(|s| s.sigma_px).sum::<f32>() / found.len() as f32;
        assert!(mean_sigma_px > 1.05 * last_sigma_px, "{mean_sigma_px} px with {most}, {last_sigma_px} px with more");
        last_sigma_px = mean_sigma_px;
        let in_left_half = found.iter().filter(|s| s.x < 30).count() as f32 / found.len() as f32;
        assert!((0.35..=0.75).contains(&in_left_half), "{in_left_half} on the left, with {most}");
    }
}

#[test]
fn a_pixel_without_confidence_is_never_sampled() {
    let doubtful_left: Vec<f32> = (0..SIZE.n_pixels()).map(|i| f32::from(i % SIZE.width >= 30)).collect();
    let found = drawn(&square(), &vec![0.1; SIZE.n_pixels()], 1.0, &doubtful_left);
    assert!(!found.is_empty() && found.iter().all(|s| s.x >= 30));
}

#[test]
fn depth_edges_are_where_the_depth_jumps_and_nowhere_without_depth() {
    let inverse_depth: Vec<f32> = (0..SIZE.n_pixels())
        .map(|i| match i % SIZE.width {
            0..20 => 0.1,
            20..40 => 0.05,
            _ => 0.0,
        })
        .collect();
    let mut edges = vec![9.0; SIZE.n_pixels()];
    depth_edges(&inverse_depth, SIZE, &mut edges);
    let row = &edges[10 * SIZE.width..11 * SIZE.width];
    assert!(row[20] == 1.0 && row[10] == 0.0 && row[40] == 0.0 && row[50] == 0.0, "{row:?}");
}
