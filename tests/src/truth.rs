//! Where the simulator's camera is, as the tracker says it.

use kilogs_camera::sim::Waypoint;
use kilogs_core::conventions::Rigid;
use nalgebra::{Translation3, UnitQuaternion, Vector3};

/// The camera's pose: the simulator drives on a plane, x to the right of the first view, z ahead.
pub fn world_from_camera(at: &Waypoint) -> Rigid {
    let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * at.heading_rad);
    Rigid::from_parts(Translation3::new(at.x, 0.0, at.z), turn)
}
