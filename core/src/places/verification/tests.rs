use super::super::view::PointDepth;
use super::*;
use crate::features::Descriptor;
use nalgebra::{Point3, Translation3, UnitQuaternion, Vector3};
use std::vec;
use std::vec::Vec;

const CAMERA: Pinhole = Pinhole { width: 1241, height: 376, fx: 718.0, fy: 718.0, cx: 607.0, cy: 185.0 };
const N: usize = 150;

/// What is spoilt in a scene that is a loop otherwise.
#[derive(Clone, Copy, Debug)]
struct Scene {
    scale: f64,
    distance_m: f64,
    /// Points lie within this share of the image's width.
    width: f64,
    /// Every n-th point looks like another.
    stranger_every: usize,
    /// Every n-th point is elsewhere in the second image.
    moved_every: usize,
    /// Standard deviation of the logarithm of the second depths.
    depth_noise: f64,
}

const LOOP: Scene =
    Scene { scale: 1.2, distance_m: 1.5, width: 0.9, stranger_every: N, moved_every: N, depth_noise: 0.03 };

fn truth(scene: &Scene) -> Similarity {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.01, 0.06, -0.01));
    Similarity::from_parts(Translation3::new(0.1, 0.0, scene.distance_m), rotation, scene.scale)
}

type View = (Vec<Feature>, Vec<PointDepth>);

fn views(scene: &Scene) -> (View, View) {
    let mut rng = Rng::new(4, 0, 0);
    let (mut view, mut earlier): (View, View) = Default::default();
    for i in 0..N {
        let mut random = || u64::from(rng.next_u32()) << 32 | u64::from(rng.next_u32());
        let descriptor = Descriptor([random(), random(), random(), random()]);
        let stranger = Descriptor([random(), random(), random(), random()]);
        let mut within = |half: f64| half * (2.0 * rng.unit_f64() - 1.0);
        let z_m = 25.0 + within(18.0);
        let pixel = [CAMERA.cx + within(0.5 * scene.width * 1241.0), CAMERA.cy + within(170.0)];
        let point =
            Point3::new((pixel[0] - CAMERA.cx) / CAMERA.fx * z_m, (pixel[1] - CAMERA.cy) / CAMERA.fy * z_m, z_m);
        let moved = truth(scene) * point;
        let is_moved = i % scene.moved_every == scene.moved_every - 1;
        let [jump_x, jump_y] = if is_moved { [within(400.0), within(120.0)] } else { [within(0.7), within(0.7)] };
        let Some(seen) = CAMERA.project(&moved.coords) else { continue };
        let noise = (0..3).map(|_| within(scene.depth_noise)).sum::<f64>();
        let add = |to: &mut View, pixel: [f64; 2], descriptor, depth_m: f64| {
            to.0.push(Feature { pixel: pixel.map(|c| c as f32), scale: 2.0, descriptor, ..Feature::NONE });
            to.1.push(PointDepth { depth_m: depth_m as f32, relative_sigma: 0.05 });
        };
        add(&mut view, pixel, descriptor, z_m);
        let looks = if i % scene.stranger_every == scene.stranger_every - 1 { stranger } else { descriptor };
        add(&mut earlier, [seen.x + jump_x, seen.y + jump_y], looks, moved.z * libm::exp(noise));
    }
    (view, earlier)
}

fn check(scene: Scene, expected: LoopVerdict) {
    let (view, earlier) = views(&scene);
    let scratch = &mut LoopScratch {
        nearest: &mut [Nearest::NONE; 2 * N],
        pairs: &mut [FeatureMatch::default(); N],
        matches: &mut [Match::default(); N],
        point_matches: &mut vec![PointMatch::default(); N],
        is_inlier: &mut [false; N],
    };

    let (found, evidence) = verify_loop(
        SimdLevel::new(),
        &CAMERA,
        &PlaceView { features: &view.0, depths: &view.1 },
        &PlaceView { features: &earlier.0, depths: &earlier.1 },
        &VerificationSettings::STANDARD,
        &mut Rng::new(1, 2, 3),
        scratch,
    );
    assert_eq!(evidence.verdict, expected, "{scene:?}: {evidence:?}");
    assert_eq!(found.is_some(), expected == LoopVerdict::Accepted, "{evidence:?}");
    if let Some(found) = found {
        let off = found.earlier_from_view.inverse() * truth(&scene);
        assert!((off.scaling() - 1.0).abs() < 0.02 && off.isometry.rotation.angle() < 5e-3, "{off:?}");
        assert!(off.isometry.translation.vector.norm() < 0.2, "{off:?}");
    }
}

#[test]
fn a_place_seen_again_is_accepted_and_measured() {
    check(LOOP, LoopVerdict::Accepted);
    check(Scene { scale: 0.8, distance_m: -4.0, ..LOOP }, LoopVerdict::Accepted);
    check(Scene { stranger_every: 2, moved_every: 5, ..LOOP }, LoopVerdict::Accepted);
}

#[test]
fn each_bar_stops_what_it_is_for() {
    check(Scene { stranger_every: 1, ..LOOP }, LoopVerdict::TooFewMatches);
    check(Scene { moved_every: 1, ..LOOP }, LoopVerdict::TooFewEpipolar);
    check(Scene { depth_noise: 1.5, ..LOOP }, LoopVerdict::TooFewInliers);
    check(Scene { width: 0.15, ..LOOP }, LoopVerdict::OnePatch);
    check(Scene { scale: 2.5, ..LOOP }, LoopVerdict::ScaleOff);
    check(Scene { distance_m: 17.0, scale: 1.9, ..LOOP }, LoopVerdict::TooFarApart);
}

#[test]
fn a_point_described_twice_counts_once() {
    let feature = |x| Feature { pixel: [x, 1.0], ..Feature::NONE };
    let features = [feature(1.0), feature(1.0), feature(2.0)];
    let pair = |first, distance| FeatureMatch { first, second: 7 + first, distance, next_distance: 99 };
    let mut pairs = [pair(0, 20), pair(1, 10), pair(2, 30)];
    assert_eq!(keep_one_each(&mut pairs, &features), 2);
    assert_eq!(pairs[..2], [pair(1, 10), pair(2, 30)]);
}
