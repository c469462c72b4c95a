//! What a view says besides its picture and its gradients: the camera's pose and the anchors' scores, device backends
//! against the CPU backend.

use super::devices::on_every_device;
use crate::splat::cpu::SimdLevel;
use crate::splat::cpu::tests::pose::{N_ANCHORS, Problem, errors, settings};
use crate::splat::cpu::tests::scenes::K;
use crate::splat::cpu::tests::scores::{check_dots, compare_scores, dot_capacities, score};
use crate::splat::*;

#[test]
fn pose_gradients_match_the_cpu() {
    const NONE: LossWeights = LossWeights { l1: 0.0, ssim: 0.0, depth: 0.0, isotropy: 0.0, exposure: 0.0 };
    let cases = [
        ("l1", LossWeights { l1: 0.8, ..NONE }),
        ("ssim", LossWeights { ssim: 0.2, ..NONE }),
        ("depth", LossWeights { depth: 0.01, ..NONE }),
        ("everything", LossWeights::METHOD),
    ];
    for learned_decoder in [false, true] {
        let problem = Problem::new(learned_decoder);
        on_every_device(problem.capacities(), |who, backend| {
            problem.fill(backend);
            for (what, weights) in cases {
                let mut cpu = problem.cpu(SimdLevel::best(), 1);
                let expected = cpu.train_step(&problem.training(), &settings(weights)).pose_gradient.expect("asked");
                let report = backend.train_step(&problem.training(), &settings(weights));
                let got = report.pose_gradient.expect("was asked for");
                let [turn, shift] = errors(&got, &expected);
                println!("{what}, decoder {learned_decoder}, {who}: {turn:.1e}, {shift:.1e} of {expected:?}");
                assert!(turn < 1e-3 && shift < 1e-3, "{what}, decoder {learned_decoder}, {who}: {got:?}, {expected:?}");
            }
        });
    }
}

#[test]
fn a_frozen_step_changes_nothing_and_a_pose_gradient_changes_no_step() {
    let problem = Problem::new(true);
    let direct = StepSettings { decoder_row: Some(0), ..StepSettings::direct(0.0) };
    let learning =
        StepSettings { rates: LearningRates { decoder: DecoderRates::METHOD, ..LearningRates::DIRECT }, ..direct };
    let looking = settings(LossWeights::METHOD);
    on_every_device(problem.capacities(), |who, backend| {
        let mut state = |before: &[StepSettings]| {
            // Writing restarts what the optimizer remembers.
            problem.fill(backend);
            for settings in before {
                let report = backend.train_step(&problem.training(), settings);
                assert_eq!(report.pose_gradient.is_some(), settings.pose_gradient, "{who}");
            }
            // Where the next step ends tells what the optimizer remembers.
            backend.train_step(&problem.training(), &learning);
            let mut weights = vec![0.0; DecoderShape::new(K).len()];
            assert!(backend.read_decoder(0, &mut weights));
            (weights, backend.train_step(&problem.training(), &learning))
        };
        let plain = state(&[learning]);
        assert!(state(&[]) != plain, "{who}");
        assert!(state(&[looking, learning, looking]) == plain, "frozen steps with {who}");
        assert!(state(&[StepSettings { pose_gradient: true, ..learning }]) == plain, "a pose gradient with {who}");
    });
}

#[test]
fn scores_match_the_cpu_and_repeat() {
    for learned_decoder in [false, true] {
        let problem = Problem::new(learned_decoder);
        let (expected, expected_report) = score(&mut problem.cpu(SimdLevel::best(), 1), &problem.training());
        on_every_device(problem.capacities(), |who, backend| {
            problem.fill(backend);
            // Sums of a training step are no part of a score.
            backend.train_step(&problem.training(), &settings(LossWeights::METHOD));
            let (got, report) = score(backend, &problem.training());
            assert_eq!(compare_scores(&got, &expected), Ok(()), "{who}");
            let off = report.masked_pixels.abs_diff(expected_report.masked_pixels);
            assert!(off <= 1 && report.stats == expected_report.stats, "{who}: {report:?}, {expected_report:?}");
            let error = (report.loss.total - expected_report.loss.total).abs();
            assert!(error < 1e-5 && report.loss.isotropy == 0.0, "{who}: {report:?}, {expected_report:?}");
            assert!(score(backend, &problem.training()) == (got, report), "{who} repeats itself");
            let mut short = vec![AnchorScore::default(); N_ANCHORS - 1];
            assert!(backend.score_view(&problem.training(), 0.1, &mut short).stats.refused, "{who}");
        });
    }
}

#[test]
fn dots_cover_the_pixels_that_they_must() {
    on_every_device(dot_capacities(), |who, backend| check_dots(who, backend));
}
