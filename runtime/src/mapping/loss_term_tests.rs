//! What depth and exposure do for a map.

use super::*;
use crate::splat::{RenderTarget, View};

const N_KEYFRAMES: u32 = 16;
/// Keyframes at the end of the drive that the map is judged by.
const N_JUDGED: u32 = 4;

/// How far the map is from the street.
struct Errors {
    /// Against what the street really looks like, dB.
    psnr_db: f32,
    /// Mean difference of the depth that is drawn from the one that motion stereo found, weighted as in the loss, m.
    depth_m: f32,
}

/// Drives with a camera whose gain takes these values in turn, and compares the map with the street.
fn errors(gains: &[f32], settings: MapperSettings) -> Errors {
    let (mut mapper, mut sink) = (mapper_of(1, CAPACITY, settings), MemorySink::default());
    for ordinal in 0..N_KEYFRAMES {
        let gain = gains[ordinal as usize % gains.len()];
        let seen = picture(STEP_M * f64::from(ordinal)).into_iter().map(|grey| (f32::from(grey) * gain) as u8);
        let pixels: Vec<u8> = seen.collect();
        mapper.insert_keyframe(&packet(ordinal, &pixels), &mut sink).expect("a usable keyframe");
        mapper.optimize(20);
    }
    let n = (CAMERA.width * CAMERA.height) as usize;
    let (mut rgb, mut depth_m, mut transmittance) = (vec![[0.0; 3]; n], vec![0.0; n], vec![0.0; n]);
    let (mut squared, mut difference, mut weight) = (0.0, 0.0, 0.0);
    for ordinal in N_KEYFRAMES - N_JUDGED..N_KEYFRAMES {
        let z_m = STEP_M * f64::from(ordinal);
        let view = View { camera_from_map: Rigid::translation(0.0, 0.0, -z_m), camera: CAMERA, chunk_row: 0 };
        let target = RenderTarget { rgb: &mut rgb, depth_m: &mut depth_m, transmittance: &mut transmittance };
        assert!(!mapper.backend.render(&view, target).refused);
        squared += rgb.iter().zip(picture(z_m)).map(|(c, grey)| (c[0] - f32::from(grey) / 255.0).powi(2)).sum::<f32>();
        let Some(found) = mapper.depths.of(ordinal) else { continue };
        for ((&drawn_m, &found_m), &sure) in depth_m.iter().zip(found.depth_m).zip(found.confidence) {
            difference += sure * (drawn_m - found_m).abs();
            weight += sure;
        }
    }
    let psnr_db = -10.0 * (squared / (N_JUDGED as usize * n) as f32).log10();
    Errors { psnr_db, depth_m: difference / weight }
}

fn with(loss_depth: f32, learned_exposure: bool) -> MapperSettings {
    let mut settings = MapperSettings { learned_exposure, ..MapperSettings::measured(7, 1.0) };
    settings.step.weights.depth = loss_depth;
    settings
}

#[test]
fn learned_exposures_keep_a_nervous_camera_out_of_the_map() {
    let gains = [1.0, 1.25, 1.0, 0.75];
    let plain = errors(&gains, with(0.0, false));
    let corrected = errors(&gains, with(0.0, true));
    println!("{} dB instead of {} dB", corrected.psnr_db, plain.psnr_db);
    assert!(corrected.psnr_db > plain.psnr_db + 0.2, "{} dB, {} dB without", corrected.psnr_db, plain.psnr_db);
}

#[test]
fn the_depth_term_pulls_surfaces_to_where_motion_stereo_saw_them() {
    let nearly_free = errors(&[1.0], with(1e-9, false)).depth_m;
    let held = errors(&[1.0], with(0.01, false)).depth_m;
    println!("{held} m instead of {nearly_free} m");
    assert!(held < 0.7 * nearly_free, "{held} m, {nearly_free} m without the term");
}

#[test]
fn without_either_nothing_is_kept_for_them() {
    let mut mapper = mapper_of(1, CAPACITY, with(0.0, false));
    let mut with_depth = mapper_of(1, CAPACITY, with(0.01, false));
    for mapper in [&mut mapper, &mut with_depth] {
        drive(mapper, 10, &mut MemorySink::default());
    }
    assert_eq!((mapper.n_kept_depths(), with_depth.n_kept_depths()), (0, mapper.capacity().depths));
}
