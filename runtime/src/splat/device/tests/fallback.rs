//! A device that goes while a map is on it: the map goes on with the CPU backend.

use crate::splat::cpu::tests::scenes::{K, anchors, filled, render, view};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::device::{DeviceBackend, DeviceError, Executor, FallbackBackend, MakeSubstitute};
use crate::splat::program::{Buffer, Part, WorkSize};
use crate::splat::vulkan::{VulkanExecutor, testing};
use crate::splat::*;
use kilogs_core::map::decoder::FEATURE_LEN;
use nalgebra::Vector3;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

const N_ANCHORS: usize = 20;

/// A device that does nothing, and that much only for a while.
struct Dying {
    calls_left: usize,
}

impl Dying {
    fn call(&mut self) -> Result<(), DeviceError> {
        let lost = DeviceError::Lost { doing: "testing", reason: "unplugged".to_owned() };
        self.calls_left = self.calls_left.checked_sub(1).ok_or(lost)?;
        Ok(())
    }
}

impl Executor for Dying {
    fn upload(&mut self, _: Buffer, _: usize, _: &[u8]) -> Result<(), DeviceError> {
        self.call()
    }

    fn clear(&mut self, _: Buffer, _: usize, _: usize) -> Result<(), DeviceError> {
        self.call()
    }

    fn run(&mut self, _: &[Part], _: &WorkSize) -> Result<(), DeviceError> {
        self.call()
    }

    fn run_stage(&mut self, _: Part, _: usize, _: &WorkSize) -> Result<(), DeviceError> {
        self.call()
    }

    fn download(&mut self, _: Buffer, _: usize, bytes: &mut [u8]) -> Result<(), DeviceError> {
        bytes.fill(0);
        self.call()
    }

    fn device_name(&self) -> &str {
        "a device that dies"
    }

    fn device_bytes(&self) -> usize {
        0
    }
}

fn capacities() -> Capacities {
    let mut capacities = Capacities::for_map(N_ANCHORS, K, 64, 48);
    capacities.pairs *= 8;
    capacities.row_entries *= 4;
    capacities.exposure_slots = 2;
    capacities.learned_decoder = true;
    capacities
}

fn cpu() -> Result<Box<dyn SplatBackend>, String> {
    let backend = CpuBackend::new(capacities(), 1, SimdLevel::best(), |_| ()).map_err(|e| e.to_string())?;
    Ok(Box::new(backend))
}

fn with_fallback<E: Executor>(
    executor: E,
    substitute: MakeSubstitute,
) -> (FallbackBackend<DeviceBackend<E>>, Arc<AtomicBool>) {
    let has_fallen_back = Arc::new(AtomicBool::new(false));
    let device = DeviceBackend::new(capacities(), executor).unwrap_or_else(|e| panic!("{e}"));
    (FallbackBackend::new(device, substitute, Arc::clone(&has_fallen_back)), has_fallen_back)
}

fn background() -> Vec<[f32; 3]> {
    (0..BACKGROUND_TEXELS).map(|i| [i as f32 / BACKGROUND_TEXELS as f32, 0.5, 0.25]).collect()
}

/// A decoder that can be seen.
fn decoder() -> Vec<f32> {
    (0..DecoderShape::new(K).len()).map(|i| 0.2 * (i as f32).sin()).collect()
}

/// Writes a whole map, one call for each kind of thing.
fn write_map(backend: &mut dyn SplatBackend) {
    let (headers, params) = anchors(N_ANCHORS, 7);
    let slots: Vec<u32> = (0..N_ANCHORS as u32).collect();
    let shifted = KeyframePlacement { translation_m: Vector3::new(0.1, 0.0, 0.2), ..KeyframePlacement::identity() };
    assert_eq!(backend.write_anchors(&slots, &headers, &params), 0);
    assert_eq!(backend.write_features(&slots, &[[0.3; FEATURE_LEN]; N_ANCHORS]), 0);
    assert!(backend.write_decoder(0, &decoder()));
    assert_eq!(backend.set_keyframes(0, &[shifted]), 0);
    assert!(backend.write_background(0, &background()));
    assert!(backend.write_exposure(1, Exposure { gain: [2.0; 3], bias: [0.1; 3] }));
    assert_eq!(backend.retire_anchors(&[3]), 0);
}

#[test]
fn the_map_is_whole_whenever_the_device_goes() {
    let mut expected_backend = filled(capacities(), &[], &[], 1);
    write_map(&mut expected_backend);
    let expected = render(&mut expected_backend, &view(64, 48));
    assert!(expected.stats.visible > 0, "there is something to see");
    let mut undecoded = filled(capacities(), &[], &[], 1);
    write_map(&mut undecoded);
    assert!(undecoded.write_decoder(0, &vec![0.0; decoder().len()]));
    assert!(render(&mut undecoded, &view(64, 48)) != expected, "the decoder is part of it");
    // Opening takes a few calls, writing the map a few more; from before the first anchor to after the last.
    for calls_left in [8, 9, 12, 20, 40, 50, 60, 80, 100] {
        let (mut backend, has_fallen_back) = with_fallback(Dying { calls_left }, Box::new(cpu));
        write_map(&mut backend);
        // The device draws nothing; sooner or later it is gone.
        let picture = (0..100).map(|_| render(&mut backend, &view(64, 48))).find(|_| has_fallen_back.load(Relaxed));
        let picture = picture.unwrap_or_else(|| panic!("alive after {calls_left} calls"));
        assert!(picture == expected, "gone after {calls_left} calls");
        assert!(!backend.has_device());
        assert_eq!(backend.read_exposure(1).map(|e| e.gain), Some([2.0; 3]));
    }
}

#[test]
fn scores_and_pose_gradients_survive_the_device() {
    let view = view(64, 48);
    let target = vec![90; view.n_pixels()];
    let training = TrainingView { view, target: TargetImage::Gray8(&target), depth: None, exposure_slot: Some(1) };
    let looking = StepSettings { pose_gradient: true, ..StepSettings::direct(0.0).frozen() };
    let ask = |backend: &mut dyn SplatBackend| {
        let mut scores = vec![AnchorScore::default(); N_ANCHORS];
        let report = backend.score_view(&training, 0.1, &mut scores);
        (scores, report, backend.train_step(&training, &looking))
    };
    let mut expected_backend = filled(capacities(), &[], &[], 1);
    write_map(&mut expected_backend);
    let expected = ask(&mut expected_backend);
    assert!(expected.0.iter().any(|score| score.masked > 0) && expected.2.pose_gradient.is_some());
    // The device goes while it scores, while it steps, or between them.
    for calls_left in 60..90 {
        let (mut backend, has_fallen_back) = with_fallback(Dying { calls_left }, Box::new(cpu));
        write_map(&mut backend);
        while !has_fallen_back.load(Relaxed) {
            ask(&mut backend);
        }
        assert!(ask(&mut backend) == expected, "gone after {calls_left} calls");
    }
    let (mut backend, _) = with_fallback(Dying { calls_left: 8 }, Box::new(|| Err("no room".to_owned())));
    let mut scores = vec![AnchorScore::default(); N_ANCHORS];
    let refused = (0..20).map(|_| backend.score_view(&training, 0.1, &mut scores)).last().expect("20 views");
    assert!(refused.stats.refused && scores == vec![AnchorScore::default(); N_ANCHORS]);
}

#[test]
fn reads_between_the_loss_and_the_next_change_come_from_the_host() {
    let (mut backend, has_fallen_back) = with_fallback(Dying { calls_left: 1000 }, Box::new(cpu));
    write_map(&mut backend);
    let mut calls = 0;
    // Reading does not change the map, so it cannot change the backend either: it reads what the host has.
    loop {
        let (mut headers, mut params) = anchors(1, 1);
        assert_eq!(backend.read_anchors(&[0], &mut headers, &mut params), 0);
        calls += 1;
        if !backend.has_device() {
            break;
        }
        assert!(calls < 2000, "the device lives for ever");
    }
    assert!(!has_fallen_back.load(Relaxed), "the substitute is made at the next change");
    let mut texels = vec![[0.0; 3]; BACKGROUND_TEXELS];
    assert!(backend.read_background(0, &mut texels));
    assert_eq!(texels, background());
    let (mut feature, mut weights) = ([[0.0; FEATURE_LEN]], vec![0.0; decoder().len()]);
    assert!(backend.read_features(&[0], &mut feature) == 0 && backend.read_decoder(0, &mut weights));
    assert!(feature == [[0.3; FEATURE_LEN]] && weights == decoder());
    assert_eq!(backend.retire_anchors(&[0]), 0);
    assert!(has_fallen_back.load(Relaxed));
    assert!(backend.read_background(0, &mut texels));
    assert_eq!(texels, background());
}

#[test]
fn without_a_substitute_views_are_refused_and_nothing_panics() {
    let (mut backend, has_fallen_back) = with_fallback(Dying { calls_left: 8 }, Box::new(|| Err("no room".to_owned())));
    let (headers, params) = anchors(N_ANCHORS, 7);
    let slots: Vec<u32> = (0..N_ANCHORS as u32).collect();
    assert_eq!(backend.write_anchors(&slots, &headers, &params), N_ANCHORS);
    assert!(has_fallen_back.load(Relaxed));
    assert!(render(&mut backend, &view(64, 48)).stats.refused);
    let (mut read, mut read_params) = anchors(N_ANCHORS, 1);
    assert_eq!(backend.read_anchors(&slots, &mut read, &mut read_params), 0);
    assert!(read == headers && read_params == params, "what the host saw last can still be stored");
}

#[test]
fn a_vulkan_device_that_is_lost_is_replaced() {
    let Some(device) = testing::device() else { return };
    let mut executor = VulkanExecutor::new(&device, &capacities(), 1 << 30).unwrap_or_else(|e| panic!("{e}"));
    executor.lose_after(30);
    let (mut backend, has_fallen_back) = with_fallback(executor, Box::new(cpu));
    write_map(&mut backend);
    let drawn = render(&mut backend, &view(64, 48));
    assert!(backend.has_device(), "the first picture is the device's");
    let mut pictures = (0..30).map(|_| render(&mut backend, &view(64, 48)));
    let replaced = pictures.find(|_| has_fallen_back.load(Relaxed)).expect("lost within 30 pictures");
    assert_eq!(replaced.stats.visible, drawn.stats.visible);
    let far = |a: &[f32; 3], b: &[f32; 3]| a.iter().zip(b).any(|(a, b)| (a - b).abs() > 1e-3);
    let n_far = drawn.rgb.iter().zip(&replaced.rgb).filter(|(a, b)| far(a, b)).count();
    assert!(n_far * 200 <= drawn.rgb.len(), "{n_far} pixels differ between device and CPU");
}
