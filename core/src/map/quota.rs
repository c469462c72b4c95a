//! How many Gaussians the next keyframe may add.

use crate::camera::Pinhole;
use crate::conventions::Rigid;

/// How much of a street a camera gets to see, in metres of route.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RouteMeasure {
    /// What the first view is worth, m.
    pub first_view_m: f64,
    /// Turning by so much shows another street, rad.
    pub field_of_view_rad: f64,
}

impl RouteMeasure {
    /// Measure for a camera; a turn by its horizontal field of view is worth a first view.
    pub fn new(first_view_m: f64, camera: &Pinhole) -> Self {
        let half_width_z1 = 0.5 * f64::from(camera.width) / camera.fx;
        Self { first_view_m, field_of_view_rad: 2.0 * libm::atan(half_width_z1) }
    }

    /// The way from one keyframe to the next, m, with what the turn shows.
    pub fn step_m(&self, world_from_last: &Rigid, world_from_next: &Rigid) -> f64 {
        let last_from_next = world_from_last.inverse() * world_from_next;
        let turns = last_from_next.rotation.angle() / self.field_of_view_rad;
        last_from_next.translation.vector.norm() + self.first_view_m * turns
    }
}

/// So many Gaussians for each metre of route that is new: the size of a map is known before the drive.
///
/// What a keyframe shows for the first time is measured from the nearest view whose Gaussians are there: on a new street that is
/// the last keyframe, on one that was driven before it is one of then, and hardly anything is earned. The first view of a
/// map earns what [`RouteMeasure::first_view_m`] is worth, and as much is saved at most where little is missing, for where
/// much is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GaussianQuota {
    per_m: f64,
    first_view_m: f64,
    credit: f64,
}

impl GaussianQuota {
    /// For when pictures are to get all that they ask for.
    pub fn unlimited() -> Self {
        const MORE_THAN_ANY: f64 = 1e12;
        Self { credit: MORE_THAN_ANY, ..Self::new(MORE_THAN_ANY, 1.0) }
    }

    /// Quota of a drive that has not begun.
    pub fn new(gaussians_per_m: f64, first_view_m: f64) -> Self {
        Self { per_m: gaussians_per_m, first_view_m, credit: 0.0 }
    }

    /// Counts a keyframe so far from the nearest view whose Gaussians are there, m; `None` when there is none.
    pub fn arrive(&mut self, nearest_view_m: Option<f64>) {
        self.give_back(self.per_m * nearest_view_m.map_or(self.first_view_m, |m| m.min(self.first_view_m)));
    }

    /// Gaussians that may be added now.
    pub fn available(&self) -> f64 {
        self.credit.max(0.0)
    }

    /// So many were added.
    pub fn spend(&mut self, n: u32) {
        self.credit -= f64::from(n);
    }

    /// So many ended again, or were earned.
    pub fn give_back(&mut self, n: f64) {
        self.credit = (self.credit + n).min(self.per_m * self.first_view_m);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::FRAC_PI_2;
    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    #[test]
    fn way_and_turns_are_what_counts() {
        let camera = Pinhole { width: 200, height: 100, fx: 100.0, fy: 100.0, cx: 100.0, cy: 50.0 };
        let measure = RouteMeasure::new(20.0, &camera);
        let check = |(z_m, turn_rad): (f64, f64), expected_m: f64| {
            let turn = UnitQuaternion::from_scaled_axis(Vector3::y() * turn_rad);
            let step_m = measure.step_m(&Rigid::identity(), &Rigid::from_parts(Translation3::new(0.0, 0.0, z_m), turn));
            assert!((step_m - expected_m).abs() < 1e-6, "{z_m} m, {turn_rad} rad: {step_m} m");
        };
        check((2.0, 0.0), 2.0);
        // Half the field of view, which is a right angle.
        check((0.0, 0.5 * FRAC_PI_2), 10.0);
        check((1.0, -FRAC_PI_2), 21.0);
    }

    #[test]
    fn what_is_new_is_earned_and_only_so_much_is_saved() {
        let mut quota = GaussianQuota::new(100.0, 20.0);
        let mut check = |nearest_view_m: Option<f64>, spent: u32, ended: f64, available: f64| {
            quota.arrive(nearest_view_m);
            quota.spend(spent);
            quota.give_back(ended);
            assert!((quota.available() - available).abs() < 1e-6, "{nearest_view_m:?}: {quota:?}");
        };
        check(None, 1500, 0.0, 500.0);
        check(Some(2.0), 650, 0.0, 50.0);
        check(Some(0.0), 100, 0.0, 0.0);
        check(Some(1.0), 0, 10.0, 60.0);
        check(Some(10.0), 0, 0.0, 1060.0);
        check(Some(90.0), 0, 5.0, 2000.0);
        let mut unlimited = GaussianQuota::unlimited();
        unlimited.spend(u32::MAX);
        assert!(unlimited.available() > 1e11);
    }
}
