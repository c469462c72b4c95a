//! Scores against hand-sized cases and against a view drawn pixel by pixel in f64.

use super::pose::{EXPOSURE, N_ANCHORS, Problem};
use super::scenes::{read, view};
use crate::seal;
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;

pub const THRESHOLD: f32 = 0.2;

/// Scores of a view.
pub fn score(backend: &mut dyn SplatBackend, training: &TrainingView<'_>) -> (Vec<AnchorScore>, ScoreReport) {
    let poison = AnchorScore { covered: 77, masked: 78, radius_px: -1.0 };
    let mut scores = vec![poison; backend.capacities().anchors];
    let report = backend.score_view(training, THRESHOLD, &mut scores);
    (scores, report)
}

/// Scores and marked pixels by their definition, in f64.
fn expected(problem: &Problem) -> (Vec<AnchorScore>, u32) {
    let picture = problem.map.draw(&problem.view);
    let TargetImage::RgbF32(target) = problem.training().target else { panic!("RgbF32") };
    let (mut scores, mut n_marked) = (vec![AnchorScore::default(); N_ANCHORS], 0);
    for ((rgb, target), contributions) in picture.rgb.iter().zip(target).zip(&picture.contributions) {
        let exposed = |i: usize| f64::from(EXPOSURE.gain[i]) * rgb[i] + f64::from(EXPOSURE.bias[i]);
        let error = (0..3).map(|i| (exposed(i) - f64::from(target[i])).abs()).sum::<f64>() / 3.0;
        let marked = u32::from(error > f64::from(THRESHOLD));
        n_marked += marked;
        for (id, _) in contributions.iter().filter(|(_, weight)| *weight >= 1.0 / 255.0) {
            let score = &mut scores[id / problem.map.k];
            score.covered += 1;
            score.masked += marked;
        }
    }
    for (id, radius_px) in picture.radii_px {
        let largest = &mut scores[id / problem.map.k].radius_px;
        *largest = largest.max(radius_px as f32);
    }
    (scores, n_marked)
}

/// Counts but for those in the band where rounding decides, radii to within rounding.
pub fn compare_scores(got: &[AnchorScore], expected: &[AnchorScore]) -> Result<(), String> {
    if got.len() != expected.len() || got.is_empty() {
        return Err(format!("{} scores, expected {}", got.len(), expected.len()));
    }
    for (what, count) in [("covered", (|s| s.covered) as fn(&AnchorScore) -> u32), ("masked", |s| s.masked)] {
        let total: u32 = expected.iter().map(count).sum();
        let off: u32 = got.iter().zip(expected).map(|(g, e)| count(g).abs_diff(count(e))).sum();
        if off > total / 500 {
            return Err(format!("{off} of {total} {what} contributions differ"));
        }
    }
    let differs = |(g, e): (&AnchorScore, &AnchorScore)| {
        // Not a number is not close to anything.
        let is_close = (g.radius_px - e.radius_px).abs() < 1e-3 * (1.0 + e.radius_px);
        !is_close
    };
    match got.iter().zip(expected).position(differs) {
        Some(slot) => Err(format!("slot {slot}: {:?}, expected {:?}", got[slot], expected[slot])),
        None => Ok(()),
    }
}

#[test]
fn scores_are_those_of_the_definition() {
    for learned_decoder in [false, true] {
        let problem = Problem::new(learned_decoder);
        let (expected, n_marked) = expected(&problem);
        let total: u32 = expected.iter().map(|s| s.covered).sum();
        let masked: u32 = expected.iter().map(|s| s.masked).sum();
        assert!(total > 2000 && masked > total / 5 && masked < total, "{masked} of {total} contributions are masked");
        for level in SimdLevel::ALL.into_iter().filter(|level| level.is_available()) {
            let (got, report) = score(&mut problem.cpu(level, 2), &problem.training());
            assert_eq!(compare_scores(&got, &expected), Ok(()), "{level}");
            assert!(report.masked_pixels.abs_diff(n_marked) <= 1, "{report:?}, expected {n_marked}");
            let settings = StepSettings { weights: LossWeights::PHOTOMETRIC, ..StepSettings::direct(0.0).frozen() };
            let step = problem.cpu(level, 2).train_step(&problem.training(), &settings);
            assert_eq!(
                (report.loss.total, report.loss.ssim, report.stats),
                (step.loss.total, step.loss.ssim, step.stats)
            );
        }
    }
}

#[test]
fn the_comparer_of_scores_can_fail() {
    let expected = expected(&Problem::new(false)).0;
    let changed = |change: &dyn Fn(&mut Vec<AnchorScore>)| {
        let mut got = expected.clone();
        change(&mut got);
        compare_scores(&got, &expected)
    };
    let busy = (0..N_ANCHORS).max_by_key(|&i| expected[i].masked).expect("anchors");
    assert_eq!(changed(&|_| ()), Ok(()));
    assert!(changed(&|s| s[busy].covered -= s[busy].covered / 5).is_err());
    assert!(changed(&|s| s[busy].masked = 0).is_err());
    assert!(changed(&|s| s[busy].radius_px *= 1.01).is_err());
    assert!(changed(&|s| s[busy].radius_px = f32::NAN).is_err());
    assert!(changed(&|s| s.swap(busy, (busy + 1) % N_ANCHORS)).is_err());
    assert!(changed(&|s| s.truncate(3)).is_err() && compare_scores(&[], &[]).is_err());
}

/// Gaussians that are smaller than a pixel, so that the low-pass filter is all of their size, in front of the centre of
/// pixel (8, 8): at which distance, and how opaque.
fn write_dots(backend: &mut dyn SplatBackend, slot: u32, gaussians: &[(f32, f32)]) {
    const EXTENT_M: f32 = 1e-5;
    let header = AnchorHeader {
        position_in_keyframe_m: [0.0; 3],
        keyframe_row: 0,
        log_extent: [EXTENT_M.ln(); 3],
        level: 0,
        n_gaussians: gaussians.len() as u8,
        chunk_row: 0,
    };
    let params = |&(z_m, opacity): &(f32, f32)| GaussianParams {
        offset: [0.0, 0.0, z_m / EXTENT_M],
        log_scale: [0.0; 3],
        quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
        opacity_logit: (opacity / (1.0 - opacity)).ln(),
        color_logit: [0.0; 3],
    };
    let own = [params(&gaussians[0]), params(gaussians.last().expect("one or two"))];
    assert_eq!(backend.write_anchors(&[slot], &[header], &own), 0);
}

/// Capacities for [`check_dots`].
pub fn dot_capacities() -> Capacities {
    Capacities { pairs: 64, ..Capacities::for_map(2, 2, 17, 17) }
}

/// Hand-sized cases: distance and opacity of the Gaussians of up to two anchors, the column from which on the picture is
/// wrong, and what both anchors score.
pub fn check_dots(who: &str, backend: &mut dyn SplatBackend) {
    let mut view = view(17, 17);
    (view.camera.cx, view.camera.cy) = (8.5, 8.5);
    let mut check = |what: &str, anchors: &[&[(f32, f32)]], wrong_from_column: usize, expected: [(u32, u32); 2]| {
        assert_eq!(backend.retire_anchors(&[0, 1]), 0);
        for (slot, gaussians) in anchors.iter().enumerate() {
            write_dots(backend, slot as u32, gaussians);
        }
        // Gaussians and sky are the same grey.
        let target: Vec<u8> = (0..17 * 17).map(|i| if i % 17 >= wrong_from_column { 255 } else { 128 }).collect();
        let training = TrainingView { view, target: TargetImage::Gray8(&target), depth: None, exposure_slot: None };
        let (scores, report) = score(backend, &training);
        let got: Vec<(u32, u32)> = scores.iter().map(|s| (s.covered, s.masked)).collect();
        assert_eq!(got, expected, "{what} with {who}");
        assert_eq!(report.masked_pixels as usize, 17 * (17 - wrong_from_column), "{what} with {who}");
    };
    // alpha >= 1/255 where r^2 <= 2 * 0.3 px^2 * ln(255 opacity): 1.53, 2.91 and 3.32 px^2.
    check("a faint dot", &[&[(2.0, 0.05)]], 17, [(5, 0), (0, 0)]);
    check("a dot", &[&[(2.0, 0.5)]], 17, [(9, 0), (0, 0)]);
    check("a dot of which the right third is wrong", &[&[(2.0, 0.5)]], 9, [(9, 3), (0, 0)]);
    check("a dot that is all wrong", &[&[(2.0, 0.5)]], 0, [(9, 9), (0, 0)]);
    check("Gaussians of one anchor count on their own", &[&[(2.0, 0.05), (2.0, 0.05)]], 8, [(10, 8), (0, 0)]);
    // What is behind has an alpha of 0.01 in the middle, where it is seen through 0.2, and of 0.0019 around it.
    check("a dot behind another one", &[&[(3.0, 0.01)], &[(2.0, 0.8)]], 17, [(0, 0), (9, 0)]);
    check("a dot in front of another one", &[&[(1.0, 0.01)], &[(2.0, 0.8)]], 17, [(1, 0), (9, 0)]);
    check("a dot behind the camera", &[&[(-2.0, 0.5)]], 9, [(0, 0), (0, 0)]);
}

#[test]
fn dots_cover_the_pixels_that_they_must() {
    let backend = CpuBackend::new(dot_capacities(), 1, SimdLevel::best(), |_| ());
    check_dots("cpu", &mut backend.expect("backend"));
}

#[test]
fn scoring_changes_nothing_allocates_nothing_and_does_not_depend_on_threads() {
    let problem = Problem::new(true);
    let training = problem.training();
    let run = |threads: usize, with_scores: bool| {
        let mut backend = problem.cpu(SimdLevel::best(), threads);
        let mut scores = vec![AnchorScore::default(); N_ANCHORS];
        if with_scores {
            let sealed = seal::enter();
            backend.score_view(&training, THRESHOLD, &mut scores);
            assert_eq!(sealed.violations(), (0, 0));
        }
        let step = backend.train_step(&training, &StepSettings::direct(0.0));
        (scores, (read(&backend), step))
    };
    let once = run(1, true);
    assert!(once.0.iter().any(|s| s.covered > 0));
    assert!(run(1, false).1 == once.1, "scoring leaves no trace");
    assert!([2, 3].into_iter().all(|threads| run(threads, true) == once));
}

#[test]
fn what_does_not_fit_is_refused_and_left_alone() {
    let problem = Problem::new(false);
    let mut backend = problem.cpu(SimdLevel::best(), 1);
    let poison = AnchorScore { covered: 5, ..AnchorScore::default() };
    let mut scores = vec![poison; N_ANCHORS + 1];
    let mut refused =
        |training: &TrainingView<'_>, n: usize| backend.score_view(training, THRESHOLD, &mut scores[..n]).stats.refused;
    let mut too_wide = problem.training();
    too_wide.view.camera.width += 1;
    assert!(refused(&too_wide, N_ANCHORS), "a view that does not fit");
    assert!(refused(&problem.training(), N_ANCHORS + 1) && refused(&problem.training(), N_ANCHORS - 1));
    assert!(scores.iter().all(|s| *s == poison));
}
