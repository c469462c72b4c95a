//! Houses, parked cars and trees along the way.

use super::drive_kind::BareStretch;
use super::path::{Drive, SPACING_M, Waypoint};
use super::road_map::RoadMap;
use super::shapes::{Ball, Hit, Ray, UprightBox};
use crate::noise::{hash, hash_unit};

/// What a solid is made of; decides its texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Material {
    /// House front with windows.
    Facade,
    /// Body of a car.
    CarBody,
    /// Windows of a car.
    CarCabin,
    /// Trunk of a tree, or a pole.
    Trunk,
    /// Leaves.
    Crown,
}

/// One solid of the town.
#[derive(Clone, Copy, Debug)]
pub enum Shape {
    /// House, car, trunk.
    Box(UprightBox),
    /// Crown.
    Ball(Ball),
}

/// A solid with its look.
#[derive(Clone, Copy, Debug)]
pub struct Solid {
    /// Where it is.
    pub shape: Shape,
    /// What it is made of.
    pub material: Material,
    /// Makes each one look different.
    pub seed: u32,
}

impl Solid {
    /// First intersection nearer than `limit_m`.
    pub fn intersect(&self, ray: &Ray, limit_m: f32) -> Option<Hit> {
        match &self.shape {
            Shape::Box(solid) => solid.intersect(ray, limit_m),
            Shape::Ball(solid) => solid.intersect(ray, limit_m),
        }
    }
}

/// Right edge of our lane, seen from the path, m; lanes are 3.5 m, the camera drives in the middle of the right one.
pub const LANE_RIGHT_M: f32 = 1.75;
/// Middle of the road, m.
pub const CENTER_LINE_M: f32 = -1.75;
/// Left edge of the oncoming lane, m.
pub const LANE_LEFT_M: f32 = -5.25;
/// Parking strips reach this far beyond either lane, m.
pub const PARKING_M: f32 = 2.3;
/// No solid stands nearer to any point of the way than this, m: half a car and a mirror's clearance.
const CLEARANCE_M: f32 = 1.6;
/// Highest house, m, over the ground.
const MAX_HEIGHT_M: f32 = 16.0;

/// The wall of a bare stretch: behind the edge of the road, and over it, m.
const WALL_DISTANCE_M: f32 = 1.0;
const WALL_HEIGHT_M: f32 = 9.0;

/// The town: every solid that stands still, and the road.
#[derive(Debug)]
pub struct Town {
    solids: Vec<Solid>,
    road: RoadMap,
    waypoints: Vec<Waypoint>,
    bare_stretch: Option<BareStretch>,
}

/// Where a point of the ground lies on the road.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RoadPosition {
    /// Along the way, m.
    pub along_m: f32,
    /// To the right of the way, m.
    pub lateral_m: f32,
}

impl Town {
    /// Builds the town along a drive.
    pub fn build(drive: &Drive, seed: u64) -> Self {
        let waypoints = drive.waypoints().to_vec();
        let (road, bare_stretch) = (RoadMap::build(&waypoints), drive.bare_stretch());
        let mut town = Self { solids: Vec::new(), road, waypoints, bare_stretch };
        let seed = hash(seed as i32, (seed >> 32) as i32, 1);
        for side in [-1.0, 1.0_f32] {
            town.line_with_houses(side, seed);
            town.line_with_cars(side, seed);
            town.line_with_trees(side, seed);
        }
        if let Some(stretch) = bare_stretch {
            town.clear(stretch, seed);
        }
        town
    }

    /// Takes away what stands on a bare stretch, and puts its wall there.
    fn clear(&mut self, stretch: BareStretch, seed: u32) {
        // The stretch is straight and lies along the z axis.
        self.solids.retain(|solid| match &solid.shape {
            Shape::Box(solid) => solid.center[1] + solid.half[1] < stretch.from_m,
            Shape::Ball(solid) => solid.center[2] + solid.radius < stretch.from_m,
        });
        if stretch.has_wall {
            let half_length_m = 0.5 * (self.waypoints.len() as f32 * SPACING_M as f32 - stretch.from_m);
            let half = [0.5, half_length_m];
            let center = [side_edge_m(1.0) + WALL_DISTANCE_M + half[0], stretch.from_m + half_length_m];
            let wall = UprightBox { center, half, heading: [0.0, 1.0], height: [0.0, WALL_HEIGHT_M] };
            self.solids.push(Solid { shape: Shape::Box(wall), material: Material::Facade, seed });
        }
    }

    /// Whether nothing but one plane is to be seen somewhere; the sky then has no clouds.
    pub fn has_bare_stretch(&self) -> bool {
        self.bare_stretch.is_some()
    }

    /// Whether the ground has no texture here, `z` metres from the start.
    pub fn is_bare_ground(&self, z: f32) -> bool {
        self.bare_stretch.is_some_and(|stretch| stretch.has_wall && z > stretch.from_m)
    }

    /// Every solid that stands still.
    pub fn solids(&self) -> &[Solid] {
        &self.solids
    }

    /// Position of a ground point on the road; `None` away from it.
    pub fn road_position(&self, x: f32, z: f32) -> Option<RoadPosition> {
        let mut index = self.road.waypoint_near(x, z)?;
        // The cell knows a waypoint near by; a few steps along the way reach the nearest one.
        for _ in 0..3 {
            let (along, _) = self.relative(index, x, z);
            let step = (along / SPACING_M as f32).round() as i64;
            let next = (index as i64 + step).clamp(0, self.waypoints.len() as i64 - 1) as usize;
            if next == index {
                break;
            }
            index = next;
        }
        let (along, lateral_m) = self.relative(index, x, z);
        Some(RoadPosition { along_m: index as f32 * SPACING_M as f32 + along, lateral_m })
    }

    /// Distance along and to the right of a waypoint, m.
    fn relative(&self, index: usize, x: f32, z: f32) -> (f32, f32) {
        let at = self.waypoints[index];
        let (fx, fz) = at.forward();
        let (dx, dz) = (f64::from(x) - at.x, f64::from(z) - at.z);
        ((dx * fx + dz * fz) as f32, (dx * fz - dz * fx) as f32)
    }

    /// Distance from a ground point to the way, m; the map's reach where no road is near.
    fn distance_to_way(&self, x: f32, z: f32) -> f32 {
        self.road_position(x, z).map_or(super::road_map::REACH_M, |position| position.lateral_m.abs())
    }

    /// Adds a box if it leaves the way clear everywhere around its footprint.
    fn place(&mut self, solid: UprightBox, clearance_m: f32, material: Material, seed: u32) -> bool {
        let [sin, cos] = solid.heading;
        let clear = (-4..=4).flat_map(|i| (-4..=4).map(move |j| (i as f32 / 4.0, j as f32 / 4.0))).all(|(u, v)| {
            let (right, ahead) = (u * solid.half[0], v * solid.half[1]);
            let x = solid.center[0] + cos * right + sin * ahead;
            let z = solid.center[1] - sin * right + cos * ahead;
            self.distance_to_way(x, z) >= clearance_m
        });
        if clear {
            self.solids.push(Solid { shape: Shape::Box(solid), material, seed });
        }
        clear
    }

    fn line_with_houses(&mut self, side: f32, seed: u32) {
        let mut along_m = 0.0_f32;
        let mut number = 0;
        while (along_m as f64) < self.waypoints.len() as f64 * SPACING_M {
            number += 1;
            let pick = |purpose| hash_unit(number, side as i32, seed.wrapping_add(purpose));
            let (width_m, depth_m) = (8.0 + 10.0 * pick(1), 8.0 + 4.0 * pick(2));
            let (height_m, gap_m) = (4.5 + (MAX_HEIGHT_M - 4.5) * pick(3) * pick(4), 6.0 * pick(5) * pick(5));
            let front_m = side_edge_m(side) + side * (2.5 + 3.0 * pick(6));
            let at = self.waypoint(along_m + 0.5 * width_m);
            let center = at.beside(f64::from(front_m + side * 0.5 * depth_m));
            let house = upright(at, center, [0.5 * depth_m, 0.5 * width_m], [0.0, height_m]);
            self.place(house, PARKING_M + LANE_RIGHT_M + 1.5, Material::Facade, hash(number, side as i32, seed));
            along_m += width_m + gap_m;
        }
    }

    fn line_with_cars(&mut self, side: f32, seed: u32) {
        let n_slots = (self.waypoints.len() as f64 * SPACING_M / 6.0) as i32;
        for slot in 1..n_slots {
            let pick = |purpose| hash_unit(slot, side as i32, seed.wrapping_add(purpose));
            if pick(11) > 0.45 {
                continue;
            }
            let at = self.waypoint(slot as f32 * 6.0 + pick(12));
            let lateral_m = side_edge_m(side) - side * (0.5 * PARKING_M + 0.1 * pick(13));
            for (solid, material) in car(at, at.beside(f64::from(lateral_m)), side < 0.0, pick(14)) {
                if !self.place(solid, CLEARANCE_M, material, hash(slot, side as i32, seed.wrapping_add(15))) {
                    break;
                }
            }
        }
    }

    fn line_with_trees(&mut self, side: f32, seed: u32) {
        let n_slots = (self.waypoints.len() as f64 * SPACING_M / 9.0) as i32;
        for slot in 0..n_slots {
            let pick = |purpose| hash_unit(slot, side as i32, seed.wrapping_add(purpose));
            if pick(21) > 0.4 {
                continue;
            }
            let at = self.waypoint(slot as f32 * 9.0 + 4.0 * pick(22));
            let center = at.beside(f64::from(side_edge_m(side) + side * (0.7 + 0.6 * pick(23))));
            let (trunk_m, crown_m) = (2.4 + pick(24), 1.0 + 0.9 * pick(25));
            let look = hash(slot, side as i32, seed.wrapping_add(26));
            if self.place(upright(at, center, [0.15, 0.15], [0.0, trunk_m]), CLEARANCE_M + 1.0, Material::Trunk, look) {
                let middle = [center.0 as f32, -(trunk_m + 0.7 * crown_m), center.1 as f32];
                let crown = Ball { center: middle, radius: crown_m };
                self.solids.push(Solid { shape: Shape::Ball(crown), material: Material::Crown, seed: look });
            }
        }
    }

    fn waypoint(&self, along_m: f32) -> Waypoint {
        self.waypoints[((f64::from(along_m) / SPACING_M) as usize).min(self.waypoints.len() - 1)]
    }
}

/// Outer edge of the parking strip on a side of the road, m to the right of the way.
fn side_edge_m(side: f32) -> f32 {
    if side > 0.0 { LANE_RIGHT_M + PARKING_M } else { LANE_LEFT_M - PARKING_M }
}

fn upright(at: Waypoint, center: (f64, f64), half: [f32; 2], height: [f32; 2]) -> UprightBox {
    let (sin, cos) = at.forward();
    UprightBox { center: [center.0 as f32, center.1 as f32], half, heading: [sin as f32, cos as f32], height }
}

/// Body and cabin of a car of about 4.3 x 1.75 x 1.45 m; `variety` in [0, 1) changes its size.
pub fn car(at: Waypoint, center: (f64, f64), facing_us: bool, variety: f32) -> [(UprightBox, Material); 2] {
    let half_length_m = 2.0 + 0.3 * variety;
    let body = upright(at, center, [0.87, half_length_m], [0.18, 0.85]);
    let back_m = if facing_us { 0.25 } else { -0.25 };
    let (fx, fz) = at.forward();
    let cabin_center = (center.0 + fx * back_m, center.1 + fz * back_m);
    let cabin = upright(at, cabin_center, [0.76, 0.55 * half_length_m], [0.85, 1.4 + 0.15 * variety]);
    [(body, Material::CarBody), (cabin, Material::CarCabin)]
}

#[cfg(test)]
mod tests {
    use super::super::drive_kind::DriveKind;
    use super::*;

    #[test]
    fn nothing_stands_in_the_way() {
        let drive = Drive::generate(DriveKind::Street, 3, 400.0, 10.0);
        let town = Town::build(&drive, 3);
        assert!(town.solids.len() > 100, "{} solids", town.solids.len());
        for (solid, at) in town.solids.iter().flat_map(|s| drive.waypoints().iter().map(move |w| (s, w))) {
            let Shape::Box(house) = &solid.shape else { continue };
            let ray = Ray {
                origin: [at.x as f32, -0.5, at.z as f32],
                direction: [at.forward().0 as f32, 0.0, at.forward().1 as f32],
            };
            assert!(house.intersect(&ray, 0.9).is_none(), "{house:?} on the way at {at:?}");
        }
    }

    #[test]
    fn a_point_beside_the_way_knows_where_it_is() {
        let drive = Drive::generate(DriveKind::Street, 3, 200.0, 10.0);
        let town = Town::build(&drive, 3);
        for along in [5.0, 40.0, 90.0, 130.0] {
            let (x, z) = drive.at(along).beside(2.0);
            let position = town.road_position(x as f32, z as f32).expect("on the road");
            assert!(
                (position.lateral_m - 2.0).abs() < 0.1 && (position.along_m - along as f32).abs() < 0.6,
                "{along}: {position:?}"
            );
        }
    }
}
