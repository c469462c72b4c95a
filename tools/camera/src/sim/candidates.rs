//! Which solids a pixel may see, found once per frame.

use super::path::Waypoint;
use super::shapes::{Hit, Ray};
use super::town::{Shape, Solid};
use kilogs_core::camera::Pinhole;

/// Width of the image columns that share a list, px.
const COLUMN_PX: usize = 8;
/// Solids that reach nearer to the camera plane than this fill the whole image, m.
const NEAR_M: f32 = 0.3;
/// Pixels by which bounds are widened, so that rounding hides nothing and sub-rays stay inside.
const MARGIN_PX: f32 = 2.0;

/// A solid with the part of the image that it can be seen in.
#[derive(Clone, Copy, Debug)]
struct Candidate {
    solid: Solid,
    nearest_m: f32,
    rows_px: (f32, f32),
}

/// The solids of one frame, by image column and from near to far.
#[derive(Debug, Default)]
pub struct Candidates {
    in_view: Vec<(Candidate, (f32, f32))>,
    columns: Vec<Vec<Candidate>>,
}

impl Candidates {
    /// Sorts the solids that the camera can see into the columns of its image.
    pub fn collect<'a>(&mut self, solids: impl Iterator<Item = &'a Solid>, frame: &Frame) {
        self.in_view.clear();
        self.in_view.extend(solids.filter_map(|solid| frame.bounds(solid)));
        self.in_view.sort_by(|a, b| a.0.nearest_m.total_cmp(&b.0.nearest_m));
        let n_columns = (frame.camera.width as usize).div_ceil(COLUMN_PX);
        self.columns.resize_with(n_columns, Vec::new);
        for (index, column) in self.columns.iter_mut().enumerate() {
            column.clear();
            let (left, right) = ((index * COLUMN_PX) as f32, ((index + 1) * COLUMN_PX) as f32);
            let meets = |&&(_, span): &&(Candidate, (f32, f32))| span.0 < right && span.1 > left;
            column.extend(self.in_view.iter().filter(meets).map(|(candidate, _)| *candidate));
        }
    }

    /// The first solid that the ray of a pixel meets nearer than `limit_m`.
    pub fn first_hit(&self, ray: &Ray, pixel: (f32, f32), limit_m: f32) -> Option<(Hit, &Solid)> {
        let column = self.columns.get(pixel.0 as usize / COLUMN_PX)?;
        let (mut nearest, mut limit_m) = (None, limit_m);
        for candidate in column {
            if candidate.nearest_m >= limit_m {
                break;
            }
            if pixel.1 < candidate.rows_px.0 || pixel.1 > candidate.rows_px.1 {
                continue;
            }
            if let Some(hit) = candidate.solid.intersect(ray, limit_m) {
                limit_m = hit.depth_m;
                nearest = Some((hit, &candidate.solid));
            }
        }
        nearest
    }
}

/// Where the camera of a frame is.
#[derive(Clone, Copy, Debug)]
pub struct Frame {
    /// Camera model.
    pub camera: Pinhole,
    /// Height of the camera over the ground, m.
    pub camera_height_m: f32,
    /// Position on the ground `(x, z)`, m.
    pub position_m: (f32, f32),
    /// Direction of view on the ground, unit.
    pub forward: (f32, f32),
    /// Beyond this nothing is seen, m.
    pub view_distance_m: f32,
}

impl Frame {
    /// A camera that looks along the way.
    pub fn new(camera: Pinhole, camera_height_m: f64, at: Waypoint, view_distance_m: f64) -> Self {
        let forward = at.forward();
        Self {
            camera,
            camera_height_m: camera_height_m as f32,
            position_m: (at.x as f32, at.z as f32),
            forward: (forward.0 as f32, forward.1 as f32),
            view_distance_m: view_distance_m as f32,
        }
    }

    /// The candidate and its columns; `None` when it is behind the camera, too far away or beside the image.
    fn bounds(&self, solid: &Solid) -> Option<(Candidate, (f32, f32))> {
        let corners = bounding_corners(&solid.shape).map(|corner| self.in_camera(corner));
        let depths = corners.map(|c| c[2]);
        let nearest_m = depths.into_iter().fold(f32::INFINITY, f32::min);
        let farthest_m = depths.into_iter().fold(f32::NEG_INFINITY, f32::max);
        if farthest_m <= 0.0 || nearest_m >= self.view_distance_m {
            return None;
        }
        if nearest_m < NEAR_M {
            let everything = (f32::NEG_INFINITY, f32::INFINITY);
            return Some((Candidate { solid: *solid, nearest_m: 0.0, rows_px: everything }, everything));
        }
        let span = |axis: usize, focal: f64, center: f64| {
            let pixels = corners.map(|c| focal as f32 * c[axis] / c[2] + center as f32);
            let low = pixels.into_iter().fold(f32::INFINITY, f32::min);
            let high = pixels.into_iter().fold(f32::NEG_INFINITY, f32::max);
            (low - MARGIN_PX, high + MARGIN_PX)
        };
        let columns_px = span(0, self.camera.fx, self.camera.cx);
        let rows_px = span(1, self.camera.fy, self.camera.cy);
        let is_in_view = columns_px.0 < self.camera.width as f32 && columns_px.1 > 0.0;
        is_in_view.then_some((Candidate { solid: *solid, nearest_m, rows_px }, columns_px))
    }

    /// The ray of an image point.
    pub fn ray(&self, u_px: f32, v_px: f32) -> Ray {
        let right = (u_px - self.camera.cx as f32) / self.camera.fx as f32;
        let down = (v_px - self.camera.cy as f32) / self.camera.fy as f32;
        let (fx, fz) = self.forward;
        Ray {
            origin: [self.position_m.0, -self.camera_height_m, self.position_m.1],
            direction: [fx + fz * right, down, fz - fx * right],
        }
    }

    fn in_camera(&self, [x, y, z]: [f32; 3]) -> [f32; 3] {
        let (fx, fz) = self.forward;
        let (dx, dz) = (x - self.position_m.0, z - self.position_m.1);
        [dx * fz - dz * fx, y + self.camera_height_m, dx * fx + dz * fz]
    }
}

/// Corners of a box around the shape, world axes.
fn bounding_corners(shape: &Shape) -> [[f32; 3]; 8] {
    let signs =
        [0, 1, 2, 3, 4, 5, 6, 7].map(|i: u8| [i & 1, i >> 1 & 1, i >> 2 & 1].map(|bit| 2.0 * f32::from(bit) - 1.0));
    match shape {
        Shape::Box(solid) => signs.map(|[right, up, ahead]| {
            let [sin, cos] = solid.heading;
            let (right, ahead) = (right * solid.half[0], ahead * solid.half[1]);
            let height = if up > 0.0 { solid.height[1] } else { solid.height[0] };
            [solid.center[0] + cos * right + sin * ahead, -height, solid.center[1] - sin * right + cos * ahead]
        }),
        Shape::Ball(solid) => {
            // The silhouette of a ball in perspective stays inside its bounding box.
            signs.map(|sign| [0, 1, 2].map(|i| solid.center[i] + sign[i] * solid.radius))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::path::Drive;
    use crate::sim::town::Town;

    #[test]
    fn no_pixel_misses_a_solid_that_a_search_through_all_of_them_finds() {
        let drive = Drive::generate(super::super::drive_kind::DriveKind::Street, 5, 200.0, 10.0);
        let town = Town::build(&drive, 5);
        let camera = Pinhole { width: 160, height: 48, fx: 93.0, fy: 93.0, cx: 80.0, cy: 23.0 };
        for arc_m in [3.0, 70.0, 110.0] {
            let frame = Frame::new(camera, 1.65, drive.at(arc_m), 180.0);
            let mut candidates = Candidates::default();
            candidates.collect(town.solids().iter(), &frame);
            for (u, v) in (0..40).flat_map(|i| (0..12).map(move |j| (4.0 * i as f32 + 0.3, 4.0 * j as f32 + 0.6))) {
                let ray = frame.ray(u, v);
                let searched = town.solids().iter().filter_map(|s| s.intersect(&ray, 180.0)).map(|h| h.depth_m);
                let expected = searched.fold(f32::INFINITY, f32::min);
                let found = candidates.first_hit(&ray, (u, v), 180.0).map_or(f32::INFINITY, |(hit, _)| hit.depth_m);
                assert_eq!(found, expected, "pixel {u} {v} at {arc_m} m");
            }
        }
    }
}
