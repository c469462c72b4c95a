//! Pictures of the device backends against the golden scenes and against the CPU backend.

use super::devices::on_every_device;
use crate::splat::cpu::tests::golden::{Scene, check_picture};

#[test]
fn pictures_match_golden() {
    for scene in Scene::all() {
        on_every_device(scene.capacities(), |who, backend| {
            scene.fill(backend);
            check_picture(&scene, backend, who);
        });
    }
}
