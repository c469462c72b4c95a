//! The solids that the town is built of, and where a ray enters them.

/// A ray from the camera: `origin + t * direction`, `t` in m along the optical axis. World axes: x right, y down.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Start, m.
    pub origin: [f32; 3],
    /// Direction, with unit length along the optical axis so that `t` is depth.
    pub direction: [f32; 3],
}

impl Ray {
    /// The point at depth `t`.
    pub fn at(&self, t: f32) -> [f32; 3] {
        [0, 1, 2].map(|i| self.origin[i] + t * self.direction[i])
    }
}

/// Where a ray meets a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Depth along the optical axis, m.
    pub depth_m: f32,
    /// Coordinates on the surface, m: along it, and up from the ground.
    pub surface_m: [f32; 2],
    /// Unit normal, world axes.
    pub normal: [f32; 3],
    /// Whether the surface is a roof or another horizontal face.
    pub is_top: bool,
}

/// Upright box, turned about the vertical.
#[derive(Clone, Copy, Debug)]
pub struct UprightBox {
    /// Centre of the footprint `(x, z)`, m.
    pub center: [f32; 2],
    /// Half extents across and along the heading, m.
    pub half: [f32; 2],
    /// Sine and cosine of the heading.
    pub heading: [f32; 2],
    /// Height of lower and upper face over the ground, m.
    pub height: [f32; 2],
}

/// A ball, such as a tree's crown.
#[derive(Clone, Copy, Debug)]
pub struct Ball {
    /// Centre, world axes (y down), m.
    pub center: [f32; 3],
    /// Radius, m.
    pub radius: f32,
}

impl UprightBox {
    /// First intersection nearer than `limit_m`, from outside.
    ///
    /// # Source
    /// The slab method, Kay & Kajiya 1986.
    pub fn intersect(&self, ray: &Ray, limit_m: f32) -> Option<Hit> {
        let [sin, cos] = self.heading;
        let (ox, oz) = (ray.origin[0] - self.center[0], ray.origin[2] - self.center[1]);
        let turn = |x: f32, z: f32| (cos * x - sin * z, sin * x + cos * z);
        let (local_ox, local_oz) = turn(ox, oz);
        let (local_dx, local_dz) = turn(ray.direction[0], ray.direction[2]);
        let slab = |o: f32, d: f32, low: f32, high: f32| {
            let inverse = 1.0 / d;
            let (a, b) = ((low - o) * inverse, (high - o) * inverse);
            (a.min(b), a.max(b))
        };
        let x = slab(local_ox, local_dx, -self.half[0], self.half[0]);
        let z = slab(local_oz, local_dz, -self.half[1], self.half[1]);
        let y = slab(ray.origin[1], ray.direction[1], -self.height[1], -self.height[0]);
        let (enter, leave) = (x.0.max(z.0).max(y.0), x.1.min(z.1).min(y.1));
        if !(enter > 0.0 && enter <= leave && enter < limit_m) {
            return None;
        }
        let (px, pz) = (local_ox + enter * local_dx, local_oz + enter * local_dz);
        let up_m = -(ray.origin[1] + enter * ray.direction[1]);
        let world = |nx: f32, nz: f32| [cos * nx + sin * nz, 0.0, cos * nz - sin * nx];
        // A face's coordinate is offset by its side, so that no two faces carry the same picture.
        let (surface_m, normal, is_top) = if enter == x.0 {
            let side = -local_dx.signum();
            ([pz + side * 31.0, up_m], world(side, 0.0), false)
        } else if enter == z.0 {
            let side = -local_dz.signum();
            ([px + side * 57.0, up_m], world(0.0, side), false)
        } else {
            ([px, pz], [0.0, -ray.direction[1].signum(), 0.0], true)
        };
        Some(Hit { depth_m: enter, surface_m, normal, is_top })
    }
}

impl Ball {
    /// First intersection nearer than `limit_m`, from outside.
    pub fn intersect(&self, ray: &Ray, limit_m: f32) -> Option<Hit> {
        let to = [0, 1, 2].map(|i| ray.origin[i] - self.center[i]);
        let dot = |a: &[f32; 3], b: &[f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let (a, b) = (dot(&ray.direction, &ray.direction), dot(&to, &ray.direction));
        let c = dot(&to, &to) - self.radius * self.radius;
        let discriminant = b * b - a * c;
        if discriminant < 0.0 || b >= 0.0 {
            return None;
        }
        let depth_m = (-b - discriminant.sqrt()) / a;
        if !(depth_m > 0.0 && depth_m < limit_m) {
            return None;
        }
        let normal = [0, 1, 2].map(|i| (to[i] + depth_m * ray.direction[i]) / self.radius);
        let around_m = normal[0].atan2(normal[2]) * self.radius;
        let up_m = -normal[1].clamp(-1.0, 1.0).asin() * self.radius;
        Some(Hit { depth_m, surface_m: [around_m, up_m], normal, is_top: false })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FORWARD: Ray = Ray { origin: [0.0, -1.0, 0.0], direction: [0.0, 0.0, 1.0] };

    #[test]
    fn a_box_ahead_is_hit_on_its_near_face() {
        let house = UprightBox { center: [0.5, 10.0], half: [2.0, 3.0], heading: [0.0, 1.0], height: [0.0, 5.0] };
        let hit = house.intersect(&FORWARD, 100.0).expect("straight ahead");
        assert_eq!((hit.depth_m, hit.normal, hit.surface_m[1]), (7.0, [0.0, 0.0, -1.0], 1.0));
        assert_eq!(house.intersect(&FORWARD, 6.9), None, "beyond the limit");
        let over = Ray { origin: [0.0, -6.0, 0.0], ..FORWARD };
        assert_eq!(house.intersect(&over, 100.0), None, "above the roof");
    }

    #[test]
    fn a_turned_box_shows_its_turned_face() {
        // Turned by 90 degrees, the long side lies across the road.
        let house = UprightBox { center: [0.0, 10.0], half: [1.0, 4.0], heading: [1.0, 0.0], height: [0.0, 5.0] };
        let hit = house.intersect(&FORWARD, 100.0).expect("straight ahead");
        assert!((hit.depth_m - 9.0).abs() < 1e-5, "{hit:?}");
        assert!((hit.normal[2] + 1.0).abs() < 1e-5, "{hit:?}");
    }

    #[test]
    fn a_ball_is_hit_at_its_front_and_not_from_inside() {
        let crown = Ball { center: [0.0, -1.0, 8.0], radius: 2.0 };
        assert_eq!(crown.intersect(&FORWARD, 100.0).map(|h| h.depth_m), Some(6.0));
        let inside = Ball { center: [0.0, -1.0, 1.0], radius: 2.0 };
        assert_eq!(inside.intersect(&FORWARD, 100.0), None);
    }
}
