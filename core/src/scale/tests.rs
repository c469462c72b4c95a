use super::*;
use crate::camera::{Mounting, Pinhole};
use crate::conventions::Rigid;
use crate::features::SimdLevel;
use crate::frame::{ImageView, Pyramid, pyramid::bytes_needed};
use nalgebra::Vector3;
use std::vec::Vec;

const CAMERA: Pinhole = Pinhole { width: 640, height: 240, fx: 360.0, fy: 360.0, cx: 320.0, cy: 110.0 };
const MOUNTING: Mounting =
    Mounting { height_m: 1.5, pitch_rad: 0.0, roll_rad: 0.0, forward_axis: [0.0, 0.0, 1.0], lever_arm_m: [0.0; 3] };
const SETTINGS: RoadSettings = RoadSettings {
    distance_m: [4.0, 14.0],
    half_width_m: 3.0,
    standing_grey: 2.0,
    bend: 1.0,
    normal_sigma_rad: [0.02, 0.02],
    working_width_px: 600,
    max_iterations: 15,
    min_pixels: 200,
    min_correlation: 0.6,
    min_margin: 5.0,
    min_flow_px: 3.0,
};

/// Smooth texture of the road at x, z metres, 0..255.
fn road_grey(x: f64, z: f64) -> f64 {
    let wave = |a: f64, b: f64, c: f64| libm::sin(a * x + b * z + c);
    128.0
        + 25.0 * wave(3.1, 1.7, 0.3)
        + 25.0 * wave(-2.0, 4.3, 1.0)
        + 20.0 * wave(4.0, 5.0, 2.0)
        + 15.0 * wave(6.0, -3.1, 0.7)
}

/// A camera over a flat road: `normal` in camera axes, `height` m.
fn picture(world_from_camera: &Rigid, normal: &Vector3<f64>, height: f64) -> Vec<u8> {
    let mut pixels = Vec::with_capacity(640 * 240);
    for row in 0..240 {
        for column in 0..640 {
            let ray = Vector3::new(
                (column as f64 + 0.5 - CAMERA.cx) / CAMERA.fx,
                (row as f64 + 0.5 - CAMERA.cy) / CAMERA.fy,
                1.0,
            );
            // The road is fixed to the world, which is the first camera.
            let (origin, direction) = (world_from_camera.translation.vector, world_from_camera.rotation * ray);
            let along = (height - normal.dot(&origin)) / normal.dot(&direction);
            let grey = if along > 0.0 && along < 200.0 {
                let p = origin + direction * along;
                road_grey(p.x, p.z)
            } else {
                200.0
            };
            pixels.push(grey as u8);
        }
    }
    pixels
}

struct Case {
    /// Motion between the images.
    step: Rigid,
    /// Factor by which the motion handed in is too long.
    too_long: f64,
    /// True pitch of the road against the mounting, rad.
    pitch_rad: f64,
}

fn measure(case: &Case, spoil: impl Fn(&mut [u8], &mut [u8])) -> Result<RoadAlignment, RoadProblem> {
    measure_with(&SETTINGS, KNOWN, case, spoil)
}

/// Heights tried when the length of the step is about known, and when it is not.
const KNOWN: [f64; 2] = [0.75, 1.33];
const UNKNOWN: [f64; 2] = [0.15, 6.0];

fn measure_with(
    settings: &RoadSettings,
    range: [f64; 2],
    case: &Case,
    spoil: impl Fn(&mut [u8], &mut [u8]),
) -> Result<RoadAlignment, RoadProblem> {
    let normal = Vector3::new(0.0, libm::cos(case.pitch_rad), libm::sin(case.pitch_rad));
    let mut earlier_px = picture(&Rigid::identity(), &normal, MOUNTING.height_m);
    let mut later_px = picture(&case.step, &normal, MOUNTING.height_m);
    spoil(&mut earlier_px, &mut later_px);
    let bytes = bytes_needed(640, 240, 3);
    let (mut first, mut second) = (std::vec![0; bytes], std::vec![0; bytes]);
    let mut earlier = Pyramid::new(&mut first, 640, 240, 3).expect("enough bytes");
    let mut later = Pyramid::new(&mut second, 640, 240, 3).expect("enough bytes");
    earlier.build(ImageView::new(&earlier_px, 640, 240, 640).expect("size")).expect("size");
    later.build(ImageView::new(&later_px, 640, 240, 640).expect("size")).expect("size");
    let mut earlier_from_later = case.step;
    earlier_from_later.translation.vector *= case.too_long;
    let pair = RoadPair {
        later: &later,
        earlier: &earlier,
        camera: &CAMERA,
        earlier_from_later,
        expected_normal: MOUNTING.road_normal_in_camera(),
        expected_height_m: MOUNTING.height_m,
    };
    align_road(SimdLevel::new(), &pair, range, &MOUNTING, settings)
}

fn forward(metres: f64, yaw_rad: f64) -> Rigid {
    Rigid::new(Vector3::new(0.0, 0.0, metres), Vector3::y() * yaw_rad)
}

fn check(case: &Case) {
    let found = measure(case, |_, _| ()).expect("a textured road");
    let expected_m = MOUNTING.height_m * case.too_long;
    let error = found.height_m / expected_m - 1.0;
    assert!(error.abs() < 0.015, "{found:?}, expected {expected_m} m");
    let pitch_rad = libm::atan2(found.normal_in_camera.z, found.normal_in_camera.y);
    assert!((pitch_rad - case.pitch_rad).abs() < 0.004, "pitch {pitch_rad}");
}

#[test]
fn the_height_comes_out_in_the_scale_of_the_motion() {
    check(&Case { step: forward(1.0, 0.0), too_long: 1.0, pitch_rad: 0.0 });
    check(&Case { step: forward(1.5, 0.0), too_long: 1.08, pitch_rad: 0.0 });
    check(&Case { step: forward(1.5, 0.0), too_long: 0.93, pitch_rad: 0.01 });
    check(&Case { step: forward(1.0, 0.03), too_long: 1.0, pitch_rad: -0.01 });
}

#[test]
fn a_car_that_rides_along_does_not_shorten_the_step() {
    let case = Case { step: forward(1.2, 0.0), too_long: 1.0, pitch_rad: 0.0 };
    let found = measure(&case, |earlier, later| {
        for row in 130..175 {
            for column in 285..355 {
                let grey = if (row / 6 + column / 6) % 2 == 0 { 20 } else { 230 };
                (earlier[row * 640 + column], later[row * 640 + column]) = (grey, grey);
            }
        }
    })
    .expect("road around the car");
    assert!((found.height_m / MOUNTING.height_m - 1.0).abs() < 0.02, "{found:?}");
}

#[test]
fn what_is_no_road_is_refused_with_its_number() {
    let standing = Case { step: forward(0.01, 0.0), too_long: 1.0, pitch_rad: 0.0 };
    assert!(matches!(measure(&standing, |_, _| ()), Err(RoadProblem::TooLittleMotion { .. })));
    let case = Case { step: forward(1.0, 0.0), too_long: 1.0, pitch_rad: 0.0 };
    let mut rng = crate::math::Rng::new(1, 1, 1);
    let noise: Vec<u8> = (0..640 * 240).map(|_| rng.below(256) as u8).collect();
    let different = measure(&case, |_, later| later.copy_from_slice(&noise));
    assert!(different.is_err(), "{different:?}");
    let black = measure(&case, |earlier, later| {
        earlier.fill(0);
        later.fill(0);
    });
    assert!(black.is_err(), "{black:?}");
}

#[test]
fn a_coarse_level_that_is_too_small_is_left_out() {
    let case = Case { step: forward(1.0, 0.0), too_long: 1.02, pitch_rad: 0.0 };
    let n_pixels = measure(&case, |_, _| ()).expect("a textured road").n_pixels;
    let of_pixels = |min_pixels| measure_with(&RoadSettings { min_pixels, ..SETTINGS }, KNOWN, &case, |_, _| ());
    // The coarse level has a quarter of the pixels.
    let found = of_pixels(n_pixels / 2).expect("the working level has enough");
    assert!((found.height_m / (MOUNTING.height_m * 1.02) - 1.0).abs() < 0.015, "{found:?}");
    assert!(matches!(of_pixels(2 * n_pixels), Err(RoadProblem::TooFewPixels { .. })));
}

/// Pixels of something upright that the road does not explain: dark and bright squares.
fn paint(pixels: &mut [u8], columns: core::ops::Range<usize>, rows: core::ops::Range<usize>, shift: usize) {
    for row in rows.clone() {
        for column in columns.clone() {
            let grey = if ((row - rows.start) / 6 + (column - columns.start + shift) / 8).is_multiple_of(2) {
                20
            } else {
                230
            };
            pixels[row * 640 + column] = grey;
        }
    }
}

/// What hides a part of the road, or pretends to be road, does not change what the rest says; `too_long` is found
/// although nothing about the length is known.
#[test]
fn the_road_wins_the_election() {
    let check = |what: &str, metres: f64, too_long: f64, range: [f64; 2], spoil: &dyn Fn(&mut [u8], &mut [u8])| {
        let case = Case { step: forward(metres, 0.0), too_long, pitch_rad: 0.0 };
        let found = measure_with(&SETTINGS, range, &case, spoil).unwrap_or_else(|e| panic!("{what}: {e}"));
        let error = found.height_m / (MOUNTING.height_m * too_long) - 1.0;
        assert!(error.abs() < 0.02, "{what}: {found:?}");
    };
    let nothing: &dyn Fn(&mut [u8], &mut [u8]) = &|_, _| ();
    check("an unknown step", 1.3, 1.0, UNKNOWN, nothing);
    check("a step taken for a fifth", 1.5, 0.2, UNKNOWN, nothing);
    check("a step taken for thrice as long", 1.2, 3.0, UNKNOWN, nothing);
    // A third of the strip is a car that comes nearer while it drives ahead.
    let car: &dyn Fn(&mut [u8], &mut [u8]) = &|earlier, later| {
        paint(earlier, 280..360, 120..185, 0);
        paint(later, 277..363, 119..189, 0);
    };
    check("a car ahead", 1.2, 1.0, KNOWN, car);
    check("a car ahead at the start", 1.2, 0.7, UNKNOWN, car);
    // Its side stands beside the lane and moves twice as far as the road under it.
    let parked: &dyn Fn(&mut [u8], &mut [u8]) = &|earlier, later| {
        paint(earlier, 340..460, 120..190, 0);
        paint(later, 340..460, 120..190, 5);
    };
    check("a parked car", 1.2, 1.05, KNOWN, parked);
}

/// The soft shadow of a truck in the next lane rides along on one side of the strip; the road is seen through it.
#[test]
fn a_shadow_that_rides_along_rolls_the_road_no_further_than_its_crossfall() {
    let case = Case { step: forward(1.2, 0.0), too_long: 1.0, pitch_rad: 0.0 };
    let shade = |pixels: &mut [u8]| {
        for (i, pixel) in pixels.iter_mut().enumerate() {
            let (column, row) = ((i % 640) as f64, (i / 640) as f64);
            // Its edges run beside the lane, in a picture that the truck's speed keeps.
            let wave = libm::sin((column - 320.0 - 0.6 * (row - 110.0)) / 9.0 + row / 7.0);
            if column > 350.0 && row > 110.0 {
                *pixel = (f64::from(*pixel) * (0.55 + 0.25 * wave)) as u8;
            }
        }
    };
    let roll_and_error = |roll_sigma_rad: f64| {
        let settings = RoadSettings { normal_sigma_rad: [0.01, roll_sigma_rad], ..SETTINGS };
        let found = measure_with(&settings, KNOWN, &case, |earlier, later| {
            shade(earlier);
            shade(later);
        })
        .expect("the other side of the road");
        (found.normal_in_camera.x.abs(), libm::log(found.height_m / MOUNTING.height_m).abs())
    };
    let (loose, held) = (roll_and_error(0.01), roll_and_error(0.004));
    assert!(held.0 < 0.5 * loose.0 && held.1 < 0.02, "{held:?}, loose {loose:?}");
}
