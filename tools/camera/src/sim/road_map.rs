//! Which part of the way is near a point of the ground.

use super::path::Waypoint;

/// How far from the way a point is still looked up, m.
pub const REACH_M: f32 = 16.0;
/// Side of a cell, m.
const CELL_M: f32 = 4.0;
const NO_WAYPOINT: u32 = u32::MAX;

/// A grid over the town that knows a waypoint near each cell within [`REACH_M`] of the way.
#[derive(Debug)]
pub struct RoadMap {
    first_cell: (i32, i32),
    size: (i32, i32),
    nearest: Vec<u32>,
}

impl RoadMap {
    /// Covers the way and its surroundings.
    pub fn build(waypoints: &[Waypoint]) -> Self {
        let reach = (REACH_M / CELL_M).ceil() as i32;
        let cells = || waypoints.iter().map(|at| cell_of(at.x as f32, at.z as f32));
        let low = cells().fold((i32::MAX, i32::MAX), |low, cell| (low.0.min(cell.0), low.1.min(cell.1)));
        let high = cells().fold((i32::MIN, i32::MIN), |high, cell| (high.0.max(cell.0), high.1.max(cell.1)));
        let first_cell = (low.0 - reach, low.1 - reach);
        let size = (high.0 - low.0 + 2 * reach + 1, high.1 - low.1 + 2 * reach + 1);
        let n_cells = size.0 as usize * size.1 as usize;
        let mut map = Self { first_cell, size, nearest: vec![NO_WAYPOINT; n_cells] };
        let mut best_m = vec![REACH_M; n_cells];
        for (index, at) in waypoints.iter().enumerate() {
            let (cx, cz) = cell_of(at.x as f32, at.z as f32);
            for (ix, iz) in (-reach..=reach).flat_map(|dx| (-reach..=reach).map(move |dz| (cx + dx, cz + dz))) {
                let middle = |i: i32| (i as f32 + 0.5) * CELL_M;
                let distance_m = (middle(ix) - at.x as f32).hypot(middle(iz) - at.z as f32);
                if let Some(slot) = map.slot((ix, iz))
                    && distance_m < best_m[slot]
                {
                    best_m[slot] = distance_m;
                    map.nearest[slot] = index as u32;
                }
            }
        }
        map
    }

    /// Index of a waypoint near a ground point; `None` away from the way.
    pub fn waypoint_near(&self, x: f32, z: f32) -> Option<usize> {
        let index = self.nearest[self.slot(cell_of(x, z))?];
        (index != NO_WAYPOINT).then_some(index as usize)
    }

    fn slot(&self, cell: (i32, i32)) -> Option<usize> {
        let (ix, iz) = (cell.0 - self.first_cell.0, cell.1 - self.first_cell.1);
        let is_inside = (0..self.size.0).contains(&ix) && (0..self.size.1).contains(&iz);
        is_inside.then(|| (iz * self.size.0 + ix) as usize)
    }
}

fn cell_of(x: f32, z: f32) -> (i32, i32) {
    ((x / CELL_M).floor() as i32, (z / CELL_M).floor() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_waypoint_is_found_beside_the_way_and_nowhere_else() {
        let way: Vec<Waypoint> = (0..100).map(|i| Waypoint { x: 0.0, z: f64::from(i), heading_rad: 0.0 }).collect();
        let map = RoadMap::build(&way);
        for (x, z) in [(0.0, 50.0), (9.0, 20.0), (-9.0, 80.0)] {
            let found = map.waypoint_near(x, z).expect("within reach");
            assert!((found as f32 - z).abs() <= CELL_M, "{found} for {z}");
        }
        for (x, z) in [(40.0, 50.0), (0.0, 150.0), (-1e6, 3.0)] {
            assert_eq!(map.waypoint_near(x, z), None, "{x} {z}");
        }
    }
}
