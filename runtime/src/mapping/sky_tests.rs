//! What backgrounds are before steps learn them.

use super::*;
use crate::splat::{BACKGROUND_COLUMNS, BACKGROUND_ROWS, BACKGROUND_TEXELS};
use nalgebra::Vector3;

/// The background of a chunk row as the backend has it.
fn background(mapper: &Mapper, chunk_row: u16) -> Vec<[f32; 3]> {
    let mut texels = vec![[0.0; 3]; BACKGROUND_TEXELS];
    assert!(mapper.backend.read_background(chunk_row, &mut texels));
    texels
}

/// Rows of a picture that show nothing but sky: down to 6 degrees above the horizon.
const SKY_ROWS: usize = 14;

/// Three keyframes down a street with a sky of this brightness.
fn drive_under(mapper: &mut Mapper, first: u32, sky: u8, turned: &Rigid) {
    for nth in 0..3 {
        let z_m = STEP_M * f64::from(nth);
        let mut pixels = picture(z_m);
        pixels[..SKY_ROWS * CAMERA.width as usize].fill(sky);
        let world_from_camera = turned * Rigid::translation(0.0, 0.0, z_m);
        let seen = KeyframePacket { world_from_camera, ..packet(first + nth, &pixels) };
        mapper.insert_keyframe(&seen, &mut MemorySink::default()).expect("a usable keyframe");
    }
}

/// Mean brightness of the sky a little above the horizon around a column.
fn brightness(texels: &[[f32; 3]], column: usize) -> f32 {
    let (rows, columns) = (BACKGROUND_ROWS * 3 / 8..BACKGROUND_ROWS * 7 / 16, column - 3..column + 3);
    let of_row = |row: usize| columns.clone().map(move |column| texels[row * BACKGROUND_COLUMNS + column][0]);
    let values: Vec<f32> = rows.flat_map(of_row).collect();
    values.iter().sum::<f32>() / values.len() as f32
}

#[test]
fn a_sky_that_is_seen_for_the_first_time_is_shown_at_once() {
    let mut mapper = mapper(1, 16_384);
    drive_under(&mut mapper, 0, 230, &Rigid::identity());
    let to_the_right = BACKGROUND_COLUMNS / 4;
    let before = background(&mapper, 0);
    assert!((brightness(&before, to_the_right) - 230.0 / 255.0).abs() < 0.02, "nobody looked there: the mean");
    drive_under(&mut mapper, 3, 205, &Rigid::rotation(Vector3::new(0.0, core::f64::consts::FRAC_PI_2, 0.0)));
    let after = background(&mapper, 0);
    assert!((brightness(&after, to_the_right) - 205.0 / 255.0).abs() < 0.02, "{}", brightness(&after, to_the_right));
    assert_eq!(brightness(&after, 4), brightness(&before, 4), "what was known stays");
}

#[test]
fn a_new_chunk_goes_on_with_the_sky_of_the_one_before() {
    let mut mapper = mapper(1, 16_384);
    drive_under(&mut mapper, CHUNK_KEYFRAMES - 3, 230, &Rigid::identity());
    // As if steps had learnt it.
    let learnt: Vec<[f32; 3]> = (0..BACKGROUND_TEXELS).map(|texel| [texel as f32 / 8192.0; 3]).collect();
    assert!(mapper.backend.write_background(0, &learnt));
    drive_under(&mut mapper, CHUNK_KEYFRAMES, 205, &Rigid::identity());
    assert!(background(&mapper, 1) == learnt);
}
