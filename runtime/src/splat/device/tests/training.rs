//! Training steps of the device backends against the CPU backend.

use super::devices::{TrainingGradients, on_every_device};
use super::gradients::check_param_gradients;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::cpu::tests::compare::compare_gradients;
use crate::splat::cpu::tests::scenes::{K, anchors, view};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::program::Buffer;
use crate::splat::*;
use zerocopy::IntoBytes;

/// A training view of random Gaussians.
pub struct Problem {
    pub capacities: Capacities,
    headers: Vec<AnchorHeader>,
    params: Vec<GaussianParams>,
    view: View,
    target: Vec<[f32; 3]>,
    depth_m: Vec<f32>,
    confidence: Vec<f32>,
    pub settings: StepSettings,
}

const EXPOSURE: Exposure = Exposure { gain: [1.1, 0.9, 1.0], bias: [0.02, -0.03, 0.0] };

impl Problem {
    pub fn new(width: u32, height: u32, n_anchors: usize) -> Self {
        let view = view(width, height);
        let (headers, params) = anchors(n_anchors, 5);
        let mut capacities = Capacities::for_map(n_anchors, K, width, height);
        capacities.pairs *= 8;
        capacities.row_entries *= 4;
        let n = view.n_pixels();
        let wave = |i: usize, f: f32| 0.5 + 0.4 * (i as f32 * f).sin();
        let target = (0..n).map(|i| [wave(i, 0.31), wave(i, 0.11), wave(i, 0.05)]).collect();
        let confidence = (0..n).map(|i| (i % 4) as f32 / 3.0 - 0.2).collect();
        let depth_m = (0..n).map(|i| 4.0 + wave(i, 0.07)).collect();
        Self { capacities, headers, params, view, target, depth_m, confidence, settings: StepSettings::direct(0.3) }
    }

    pub fn fill(&self, backend: &mut dyn SplatBackend) {
        let slots: Vec<u32> = (0..self.headers.len() as u32).collect();
        assert_eq!(backend.write_anchors(&slots, &self.headers, &self.params), 0);
        let texels: Vec<[f32; 3]> =
            (0..BACKGROUND_TEXELS).map(|i| [0.2, 0.5, 0.8].map(|v| v + 0.1 * (i as f32 * 0.1).sin())).collect();
        assert!(backend.write_background(0, &texels));
        assert!(backend.write_exposure(0, EXPOSURE));
    }

    fn cpu(&self) -> CpuBackend {
        let mut backend = CpuBackend::new(self.capacities, 1, SimdLevel::best(), |_| ()).expect("backend");
        self.fill(&mut backend);
        backend
    }

    pub fn training(&self) -> TrainingView<'_> {
        TrainingView {
            view: self.view,
            target: TargetImage::RgbF32(&self.target),
            depth: Some(DepthTarget { depth_m: &self.depth_m, confidence: &self.confidence }),
            exposure_slot: Some(0),
        }
    }

    fn check_gradients(&self, allowed: f64) {
        let mut cpu = self.cpu();
        let mut expected = vec![[0.0; N_PARAMS]; self.params.len()];
        let (expected_report, expected_texels) =
            cpu.training_gradients(&self.training(), &self.settings, &mut expected).expect("fits");
        on_every_device(self.capacities, |who, backend| {
            self.fill(backend);
            let TrainingGradients { report, params, texels } =
                backend.training_gradients(&self.training(), &self.settings);
            check_param_gradients(&params, &expected, allowed, who);
            let result = compare_gradients(texels.as_flattened(), expected_texels.as_flattened(), 1e-3);
            println!("{who} texels: {result:?}");
            assert!(result.is_ok(), "texels with {who}: {result:?}");
            check_terms(&report.loss, &expected_report.loss, who);
            assert_eq!(report.stats, expected_report.stats, "{who}");
        });
    }
}

fn check_terms(got: &LossTerms, expected: &LossTerms, who: &str) {
    let rows = [
        ("l1", got.l1, expected.l1),
        ("ssim", got.ssim, expected.ssim),
        ("mse", got.mse, expected.mse),
        ("depth", got.depth, expected.depth),
        ("isotropy", got.isotropy, expected.isotropy),
        ("exposure", got.exposure, expected.exposure),
        ("total", got.total, expected.total),
    ];
    for (what, got, expected) in rows {
        let error = (got - expected).abs();
        assert!(error <= 1e-5 * (1.0 + expected.abs()), "{what} with {who}: {got}, expected {expected}");
    }
}

#[test]
fn training_gradients_match_the_cpu() {
    Problem::new(61, 45, 12).check_gradients(1e-3);
    Problem::new(160, 96, 300).check_gradients(1e-3);
}

#[test]
fn what_is_finished_has_no_gradient() {
    let mut problem = Problem::new(61, 45, 12);
    problem.capacities.chunk_rows = 2;
    problem.headers.iter_mut().step_by(2).for_each(|header| header.chunk_row = 1);
    problem.settings.finished = ChunkRows::NONE.with(1);
    problem.check_gradients(1e-3);
    let mut gradients = vec![[0.0; N_PARAMS]; problem.params.len()];
    problem.cpu().training_gradients(&problem.training(), &problem.settings, &mut gradients).expect("fits");
    let has_gradient = |nth: usize| gradients[nth * K..(nth + 1) * K].as_flattened().iter().any(|&g| g != 0.0);
    let n_with = |row: usize| (row..12).step_by(2).filter(|&nth| has_gradient(nth)).count();
    assert_eq!(n_with(0), 0, "anchors of chunk row 1");
    assert!(n_with(1) > 1, "anchors of chunk row 0");
}

#[test]
fn ten_steps_end_where_the_cpu_ends() {
    let problem = Problem::new(61, 45, 12);
    on_every_device(problem.capacities, |who, backend| {
        let mut cpu = problem.cpu();
        problem.fill(backend);
        for step in 0..10 {
            let expected = cpu.train_step(&problem.training(), &problem.settings);
            let got = backend.train_step(&problem.training(), &problem.settings);
            assert!(!got.stats.refused, "{who}");
            let error = (got.loss.total - expected.loss.total).abs();
            assert!(error < 1e-5 * expected.loss.total, "step {step} with {who}: {got:?}, expected {expected:?}");
        }
        let (got, expected) = (trained(backend), trained(&cpu));
        // Adam's first steps look at little but signs, so a gradient near 0 may go either way: compared as a whole.
        let result = compare_gradients(&got, &expected, 1e-4);
        println!("{who} after ten steps: {result:?}");
        assert!(result.is_ok(), "{who}: {result:?}");
        let (exposure, expected) = (backend.read_exposure(0).expect("slot"), cpu.read_exposure(0).expect("slot"));
        for (got, expected) in exposure.gain.iter().zip(expected.gain) {
            assert!((got - expected).abs() < 1e-5, "{who}: {got}, expected {expected}");
        }
    });
}

/// All trained numbers of Gaussians and background.
fn trained(backend: &dyn SplatBackend) -> Vec<f32> {
    let n = backend.capacities().anchors;
    let slots: Vec<u32> = (0..n as u32).collect();
    let (mut headers, mut params) = anchors(n, 0);
    assert_eq!(backend.read_anchors(&slots, &mut headers, &mut params), 0);
    let mut texels = vec![[0.0; 3]; BACKGROUND_TEXELS];
    assert!(backend.read_background(0, &mut texels));
    let numbers = params.as_bytes().chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    numbers.chain(texels.into_iter().flatten()).collect()
}

#[test]
fn two_runs_are_the_same_bytes() {
    let problem = Problem::new(160, 96, 200);
    let run = || {
        let mut out = Vec::new();
        on_every_device(problem.capacities, |_, backend| {
            problem.fill(backend);
            for _ in 0..5 {
                let report = backend.train_step(&problem.training(), &problem.settings);
                out.push(format!("{report:?}"));
            }
            out.extend(trained(backend).iter().map(|v| v.to_bits().to_string()));
        });
        out
    };
    assert!(run() == run(), "two runs of five steps differ");
}

#[test]
fn targets_of_bytes_are_unpacked_as_on_the_cpu() {
    let problem = Problem::new(61, 45, 12);
    // Neither length is a multiple of four.
    let bytes: Vec<u8> = (0..3 * problem.view.n_pixels()).map(|i| (i * 89 % 251) as u8).collect();
    let gray = &bytes[..problem.view.n_pixels()];
    let mut cpu = problem.cpu();
    let mut unused = vec![[0.0; N_PARAMS]; problem.params.len()];
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        for target in [TargetImage::Rgb8(&bytes), TargetImage::Gray8(gray)] {
            let training = TrainingView { target, depth: None, exposure_slot: None, ..problem.training() };
            let (expected, _) = cpu.training_gradients(&training, &problem.settings, &mut unused).expect("fits");
            let got = backend.training_gradients(&training, &problem.settings);
            check_terms(&got.report.loss, &expected.loss, who);
        }
    });
}

#[test]
fn what_does_not_fit_is_refused_and_changes_nothing() {
    let problem = Problem::new(61, 45, 12);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let before = trained(backend);
        let short = TrainingView { target: TargetImage::RgbF32(&problem.target[1..]), ..problem.training() };
        let no_slot = TrainingView { exposure_slot: Some(9), ..problem.training() };
        for training in [short, no_slot] {
            assert!(backend.train_step(&training, &problem.settings).stats.refused, "{who}");
        }
        assert!(trained(backend) == before, "{who} was changed");
    });
}

#[test]
fn sums_are_zero_between_steps_and_moments_restart() {
    let problem = Problem::new(61, 45, 12);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        backend.train_step(&problem.training(), &problem.settings);
        let n = problem.params.len();
        for (buffer, len) in [(Buffer::SplatSums, 10 * n), (Buffer::TexelSums, 6 * BACKGROUND_TEXELS)] {
            assert!(backend.words(buffer, len).iter().all(|&word| word == 0), "{who}: {buffer:?} is not cleared");
        }
        assert!(backend.words(Buffer::ParamSteps, n).contains(&1), "{who}: nothing was stepped");
        problem.fill(backend);
        for buffer in [Buffer::ParamFirst, Buffer::ParamSecond] {
            assert!(backend.words(buffer, 14 * n).iter().all(|&word| word == 0), "{who}: {buffer:?} is kept");
        }
        assert!(backend.words(Buffer::ParamSteps, n).iter().all(|&steps| steps == 0), "{who}: steps are kept");
    });
}

#[test]
fn what_is_beyond_the_picture_is_untouched() {
    const SENTINEL: u32 = 0xdead_beef;
    let mut problem = Problem::new(61, 45, 12);
    problem.capacities.training_pixels += 100;
    (problem.capacities.image_width_px, problem.capacities.image_height_px) = (100, 60);
    let n = problem.view.n_pixels();
    let buffers = [
        (Buffer::TargetPlanes, 3),
        (Buffer::ExposedPlanes, 3),
        (Buffer::Upstream, 5),
        (Buffer::WindowSums, 5),
        (Buffer::WindowSlopes, 3),
    ];
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        for (buffer, planes) in buffers {
            backend.set_words(buffer, &vec![SENTINEL; planes * problem.capacities.training_pixels]);
        }
        assert!(!backend.train_step(&problem.training(), &problem.settings).stats.refused, "{who}");
        for (buffer, planes) in buffers {
            let words = backend.words(buffer, planes * problem.capacities.training_pixels);
            assert!(words[..planes * n].iter().all(|&word| word != SENTINEL), "{who}: {buffer:?} is not filled");
            assert!(words[planes * n..].iter().all(|&word| word == SENTINEL), "{who}: {buffer:?} is overrun");
        }
    });
}

#[test]
fn a_wrong_reference_is_caught() {
    let problem = Problem::new(61, 45, 12);
    let mut wrong = problem.settings;
    wrong.weights.ssim *= 1.05;
    let mut expected = vec![[0.0; N_PARAMS]; problem.params.len()];
    problem.cpu().training_gradients(&problem.training(), &wrong, &mut expected).expect("fits");
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let got = backend.training_gradients(&problem.training(), &problem.settings);
        let colors = |g: &[[f32; N_PARAMS]]| g.iter().flat_map(|g| g[11..].to_vec()).collect::<Vec<f32>>();
        let result = compare_gradients(&colors(&got.params), &colors(&expected), 1e-3);
        assert!(result.is_err(), "{who}: SSIM may be 5 % off: {result:?}");
    });
}

#[test]
fn anchors_arrive_in_any_order_and_refused_ones_are_left_out() {
    let problem = Problem::new(61, 45, 150);
    let n = problem.headers.len();
    // Runs longer than an upload, runs of one, and a slot out of range.
    let mut slots: Vec<u32> = (20..n as u32).chain((0..20).rev()).collect();
    slots[7] = 500;
    let mut params = problem.params.clone();
    params[90 * K].offset[1] = f32::NAN;
    let mut cpu = problem.cpu();
    let expected_refused = cpu.write_anchors(&slots, &problem.headers, &params);
    assert_eq!(expected_refused, 2);
    let expected = trained(&cpu);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        assert_eq!(backend.write_anchors(&slots, &problem.headers, &params), expected_refused, "{who}");
        assert!(trained(backend) == expected, "{who}: other numbers than on the CPU");
    });
}
