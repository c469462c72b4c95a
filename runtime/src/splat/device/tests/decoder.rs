//! The learned decoder on the devices against the CPU backend.

use super::devices::on_every_device;
use crate::splat::cpu::tests::compare::compare_pictures;
use crate::splat::cpu::tests::decoder::{Scene, scene};
use crate::splat::cpu::tests::scenes::{Picture, render};
use crate::splat::cpu::{CpuBackend, SimdLevel};
use crate::splat::*;
use nalgebra::{UnitQuaternion, Vector3};

/// A keyframe that is neither where the camera is, nor turned or scaled like it.
fn moved_keyframe() -> KeyframePlacement {
    KeyframePlacement {
        rotation: UnitQuaternion::from_euler_angles(0.1, -0.2, 0.3),
        translation_m: Vector3::new(0.4, -0.2, 0.9),
        scale: 1.3,
    }
}

/// Anchors of two chunk rows that are learned, before a keyframe that has moved; a third row that nothing was written to.
struct Problem {
    scene: Scene,
    capacities: Capacities,
}

impl Problem {
    fn new() -> Self {
        let scene = scene();
        let capacities = Capacities { chunk_rows: 3, ..scene.capacities(true) };
        Self { scene, capacities }
    }

    fn fill(&self, backend: &mut dyn SplatBackend) {
        self.scene.fill(backend);
        assert_eq!(backend.set_keyframes(0, &[moved_keyframe()]), 0);
    }

    fn cpu(&self) -> CpuBackend {
        let mut backend = CpuBackend::new(self.capacities, 1, SimdLevel::best(), |_| ()).expect("backend");
        self.fill(&mut backend);
        backend
    }
}

#[test]
fn pictures_match_the_cpu() {
    let problem = Problem::new();
    let expected = render(&mut problem.cpu(), &problem.scene.view);
    let stored = {
        let mut cpu = problem.cpu();
        let zeros = vec![0.0; problem.scene.decoders[0].len()];
        assert!(cpu.write_decoder(0, &zeros) && cpu.write_decoder(1, &zeros));
        render(&mut cpu, &problem.scene.view)
    };
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        let got = render(backend, &problem.scene.view);
        let compare =
            |expected: &Picture| compare_pictures(got.rgb.as_flattened(), expected.rgb.as_flattened(), 1e-4, 0.002);
        assert_eq!(compare(&expected), Ok(()), "{who}");
        assert_eq!(got.stats, expected.stats, "{who}");
        assert!(compare(&stored).is_err(), "{who}: the residual can be seen");
    });
}
