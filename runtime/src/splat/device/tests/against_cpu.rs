//! Pictures, counts and gradients of the device backends against the CPU backend, wherever something is at its limit.

use super::devices::on_every_device;
use super::gradients::check_param_gradients;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::cpu::tests::compare::{compare_gradients, compare_pictures};
use crate::splat::cpu::tests::scenes::{K, anchors, render, view};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;
use kilogs_core::conventions::Rigid;
use kilogs_core::map::lod::BAND_STARTS_M;
use kilogs_core::math::rng::Rng;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// A map and who looks at it.
struct Scene {
    capacities: Capacities,
    headers: Vec<AnchorHeader>,
    params: Vec<GaussianParams>,
    placements: Vec<KeyframePlacement>,
    view: View,
}

const N_ANCHORS: usize = 60;

impl Scene {
    /// Random anchors within 2 to 6 m under a sky of many colors, and room for all.
    fn new(width: u32, height: u32) -> Self {
        let (headers, params) = anchors(N_ANCHORS, 5);
        let mut capacities = Capacities::for_map(N_ANCHORS, K, width, height);
        capacities.pairs *= 8;
        capacities.row_entries *= 4;
        capacities.keyframe_rows = 3;
        capacities.chunk_rows = 2;
        let view = View { chunk_row: 1, ..view(width, height) };
        Self { capacities, headers, params, placements: vec![KeyframePlacement::identity(); 3], view }
    }

    fn with(mut self, change: impl FnOnce(&mut Self)) -> Self {
        change(&mut self);
        self
    }

    fn fill(&self, backend: &mut dyn SplatBackend) {
        let slots: Vec<u32> = (0..self.headers.len() as u32).collect();
        assert_eq!(backend.write_anchors(&slots, &self.headers, &self.params), 0);
        assert_eq!(backend.set_keyframes(0, &self.placements), 0);
        for row in 0..2 {
            let wave = |i: usize, f: f32| 0.5 + 0.4 * ((i + 100 * row) as f32 * f).sin();
            let texels: Vec<_> = (0..BACKGROUND_TEXELS).map(|i| [wave(i, 0.1), wave(i, 0.7), wave(i, 1.3)]).collect();
            assert!(backend.write_background(row as u16, &texels));
        }
    }

    /// Compares picture, counts and gradients on every device; what they counted.
    fn check(&self, what: &str) -> RenderStats {
        let mut cpu = CpuBackend::new(self.capacities, 1, SimdLevel::best(), |_| ()).expect("backend");
        self.fill(&mut cpu);
        let expected = render(&mut cpu, &self.view);
        let mut rng = Rng::new(3, 1, 4);
        let upstream: [Vec<f32>; 5] =
            core::array::from_fn(|_| (0..self.view.n_pixels()).map(|_| rng.unit_f32() - 0.5).collect());
        let planes = [&upstream[0], &upstream[1], &upstream[2], &upstream[3], &upstream[4]].map(Vec::as_slice);
        let mut expected_params = vec![[f32::NAN; N_PARAMS]; self.params.len()];
        let expected_texels = cpu.gradients(&self.view, planes, &mut expected_params).expect("fits").to_vec();
        on_every_device(self.capacities, |who, backend| {
            let who = format!("{what} on {who}");
            self.fill(backend);
            let got = render(backend, &self.view);
            assert_eq!(got.stats, expected.stats, "{who}");
            for (plane, got, expected) in [
                ("rgb", got.rgb.as_flattened(), expected.rgb.as_flattened()),
                ("depth", &got.depth_m, &expected.depth_m),
                ("transmittance", &got.transmittance, &expected.transmittance),
            ] {
                assert_eq!(compare_pictures(got, expected, 1e-4, 0.002), Ok(()), "{plane} of {who}");
            }
            let (params, texels) = backend.gradients(&self.view, &upstream);
            check_param_gradients(&params, &expected_params, 1e-3, &who);
            let result = compare_gradients(texels.as_flattened(), expected_texels.as_flattened(), 1e-3);
            assert!(result.is_ok(), "texels of {who}: {result:?}");
            assert!(texels.iter().any(|texel| *texel != [0.0; 3]), "the sky of {who} is seen");
        });
        expected.stats
    }
}

#[test]
fn what_does_not_fit_is_counted_and_drawn_as_on_the_cpu() {
    let room = |what: &str, shrink: fn(&mut Capacities)| {
        Scene::new(70, 45).with(|scene| shrink(&mut scene.capacities)).check(what).overflow
    };
    assert_eq!(room("roomy", |_| ()), Overflow::default());
    assert!(room("few Gaussians", |c| c.visible_gaussians = 40).visible_gaussians > 0);
    assert!(room("few entries", |c| c.row_entries = 70).row_entries > 0);
    assert!(room("few pairs", |c| c.pairs = 90).pairs > 0);
}

#[test]
fn wherever_the_camera_is_devices_see_what_the_cpu_sees() {
    // Three keyframes beside each other; what the second and third spawned is half and twice as large.
    let placed = Scene::new(70, 45).with(|scene| {
        for (i, header) in scene.headers.iter_mut().enumerate() {
            header.keyframe_row = (i % 3) as u32;
        }
        for (placement, (scale, side_m)) in scene.placements.iter_mut().zip([(1.0, 0.0), (0.5, -0.4), (2.0, 0.3)]) {
            placement.scale = scale;
            placement.translation_m = Vector3::new(side_m, 0.1 * side_m, 0.5);
            placement.rotation = UnitQuaternion::from_euler_angles(0.05 * side_m, 0.3 * side_m, 0.1);
        }
    });
    assert!(placed.check("three keyframes").visible > 20);
    let inside = Scene::new(70, 45).with(|scene| {
        scene.view.camera_from_map.translation = Translation3::new(0.1, 0.0, -4.0);
    });
    let stats = inside.check("a camera among Gaussians");
    assert!((20..(N_ANCHORS * K) as u32 - 20).contains(&stats.visible), "some are behind it: {stats:?}");
    let turned = Scene::new(70, 45).with(|scene| {
        let around = UnitQuaternion::from_euler_angles(0.0, core::f64::consts::PI, 0.0);
        scene.view.camera_from_map = Rigid::from_parts(Translation3::identity(), around);
    });
    assert_eq!(turned.check("a camera that looks away").visible, 0);
}

#[test]
fn levels_fade_as_on_the_cpu() {
    // Around each border, anchors of the level before, of the level behind, and of one that is nowhere near.
    let faded = Scene::new(70, 45).with(|scene| {
        for (i, header) in scene.headers.iter_mut().enumerate() {
            let border = 1 + i % (BAND_STARTS_M.len() - 1);
            let side = 0.94 + 0.12 * (i as f32 / N_ANCHORS as f32);
            let distance_m = BAND_STARTS_M[border] * side;
            let [x, y, z] = header.position_in_keyframe_m;
            let factor = distance_m / (x * x + y * y + z * z).sqrt();
            header.position_in_keyframe_m = [x * factor, y * factor, z * factor];
            header.log_extent = header.log_extent.map(|l| l + factor.ln());
            header.level = [border - 1, border, (border + 2) % 5][i / 4 % 3] as u8;
        }
    });
    let stats = faded.check("faded levels");
    assert!((30..(N_ANCHORS * K) as u32 - 30).contains(&stats.visible), "some are of other levels: {stats:?}");
}

#[test]
fn sides_fade_as_on_the_cpu() {
    // Keyframes around what they see: one as the camera, one from the side, one from behind.
    let around = Scene::new(70, 45).with(|scene| {
        let middle_m = Vector3::new(0.0, 0.0, 4.0);
        for (row, (placement, turn_rad)) in scene.placements.iter_mut().zip([0.0, 1.05, 2.6]).enumerate() {
            placement.rotation = UnitQuaternion::from_euler_angles(0.0, turn_rad, 0.0);
            placement.translation_m = middle_m - placement.rotation * middle_m;
            scene.headers.iter_mut().skip(row).step_by(3).for_each(|header| header.keyframe_row = row as u32);
        }
    });
    let stats = around.check("keyframes around");
    assert!(
        (N_ANCHORS as u32 / 2..2 * N_ANCHORS as u32).contains(&stats.visible),
        "some are seen from behind: {stats:?}"
    );
}

#[test]
fn pictures_of_any_size_are_those_of_the_cpu() {
    for (width, height) in [(1, 1), (1, 40), (40, 1), (15, 17), (16, 16), (33, 31)] {
        Scene::new(width, height).check(&format!("{width}x{height}"));
    }
}
