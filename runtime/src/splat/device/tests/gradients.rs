//! Gradients of the device backends against the golden scenes and against the CPU backend.

use super::devices::on_every_device;
use crate::splat::cpu::decode::N_PARAMS;
use crate::splat::cpu::tests::compare::compare_gradients;
use crate::splat::cpu::tests::golden::{Scene, check_gradients};
use crate::splat::cpu::tests::scenes;
use crate::splat::*;
use kilogs_core::math::rng::Rng;

/// Compares the gradients of the Gaussians' numbers, group by group, as their magnitudes differ.
pub fn check_param_gradients(got: &[[f32; N_PARAMS]], expected: &[[f32; N_PARAMS]], allowed: f64, who: &str) {
    let groups = [("offset", 0..3), ("log_scale", 3..6), ("rotation", 6..10), ("opacity", 10..11), ("color", 11..14)];
    for (what, range) in groups {
        let columns = |g: &[[f32; N_PARAMS]]| g.iter().flat_map(|g| g[range.clone()].to_vec()).collect::<Vec<f32>>();
        let result = compare_gradients(&columns(got), &columns(expected), allowed);
        println!("{what} of {who}: {result:?}");
        assert!(result.is_ok(), "{what} of {who}: {result:?}");
    }
}

#[test]
fn gradients_match_golden() {
    for scene in Scene::all() {
        on_every_device(scene.capacities(), |who, backend| {
            scene.fill(backend);
            let (params, _) = backend.gradients(&scene.view, &scene.upstream());
            check_gradients(&scene, &params, who);
        });
    }
}

#[test]
fn gradients_match_the_cpu_whatever_their_size() {
    let view = scenes::view(70, 45);
    let (headers, params) = scenes::anchors(60, 5);
    let mut cpu = scenes::backend(&view, &headers, &params, 1);
    let slots: Vec<u32> = (0..headers.len() as u32).collect();
    on_every_device(*cpu.capacities(), |who, backend| {
        assert_eq!(backend.write_anchors(&slots, &headers, &params), 0);
        for magnitude in [1e-9, 1.0, 1e6] {
            let mut rng = Rng::new(3, 1, 4);
            let upstream: [Vec<f32>; 5] =
                core::array::from_fn(|_| (0..view.n_pixels()).map(|_| magnitude * (rng.unit_f32() - 0.5)).collect());
            let planes = [&upstream[0], &upstream[1], &upstream[2], &upstream[3], &upstream[4]].map(Vec::as_slice);
            let mut expected = vec![[f32::NAN; N_PARAMS]; params.len()];
            let expected_texels = cpu.gradients(&view, planes, &mut expected).expect("fits").to_vec();
            let (got, got_texels) = backend.gradients(&view, &upstream);
            for i in 0..N_PARAMS {
                let column = |g: &[[f32; N_PARAMS]]| g.iter().map(|g| g[i]).collect::<Vec<f32>>();
                let result = compare_gradients(&column(&got), &column(&expected), 1e-3);
                assert!(result.is_ok(), "number {i} at {magnitude} on {who}: {result:?}");
            }
            let result = compare_gradients(got_texels.as_flattened(), expected_texels.as_flattened(), 1e-3);
            assert!(result.is_ok(), "texels at {magnitude} on {who}: {result:?}");
        }
    });
}
