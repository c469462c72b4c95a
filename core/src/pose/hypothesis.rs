//! A step between two views that competes, and what a match costs under it.

use super::five_point::{SAMPLE_SIZE, five_point};
use super::model::{MAX_SOLUTIONS, Model};
use super::refine_relative::refine_over;
use super::{Match, RelativePose, decompose_essential, essential_of, sampson_distance};
use heapless::Vec;
use nalgebra::{Matrix3, Vector3};

/// A motion with the matrices that its cost needs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hypothesis {
    pub pose: RelativePose,
    pub essential: Matrix3<f64>,
    rotation: Matrix3<f64>,
}

impl Hypothesis {
    pub fn of(pose: &RelativePose) -> Self {
        Self { pose: *pose, essential: essential_of(pose), rotation: *pose.rotation.to_rotation_matrix().matrix() }
    }
}

impl Model<SAMPLE_SIZE> for Hypothesis {
    fn solve(sample: &[Match; SAMPLE_SIZE]) -> Vec<Matrix3<f64>, MAX_SOLUTIONS> {
        five_point(sample)
    }

    fn least_squared_distance(essential: &Matrix3<f64>, m: &Match) -> f64 {
        let r = sampson_distance(essential, m);
        r * r
    }

    /// Of the four motions behind an essential matrix, the one that has most of the sample in front of both cameras.
    fn of_solution(essential: &Matrix3<f64>, sample: &[Match; SAMPLE_SIZE]) -> Option<Self> {
        let in_front = |pose: &RelativePose| sample.iter().filter(|m| pose.in_front_of_both(m)).count();
        decompose_essential(essential)?.iter().max_by_key(|pose| in_front(pose)).map(Self::of)
    }

    /// Squared distance of a match from the nearest pair of images that a point in front of both cameras can have,
    /// to first order; exact only below `limit2`.
    ///
    /// That is the Sampson error where the match's point lies in front. Where it lies behind, the nearest in front is
    /// at infinity, so that far points, of which noise puts every second one behind, still agree, but an outlier that
    /// happens to lie on its epipolar line does not.
    ///
    /// # Source
    /// Own derivation. Both images share the error, hence half of the squared distance to the image of infinity.
    fn squared_distance(&self, m: &Match, limit2: f64) -> f64 {
        let r = sampson_distance(&self.essential, m);
        let r2 = r * r;
        if r2 >= limit2 {
            return r2;
        }
        let at_infinity = self.rotation * Vector3::new(m.first_z1.x, m.first_z1.y, 1.0);
        let second = Vector3::new(m.second_z1.x, m.second_z1.y, 1.0);
        let direction = self.pose.direction;
        let normal = at_infinity.cross(&second);
        if normal.dot(&second.cross(&direction)) > 0.0 && normal.dot(&at_infinity.cross(&direction)) > 0.0 {
            return r2;
        }
        let from_infinity2 = (at_infinity.xy() / at_infinity.z - m.second_z1).norm_squared();
        if at_infinity.z > 0.0 { r2.max(0.5 * from_infinity2) } else { f64::INFINITY }
    }

    fn refined<'m>(
        &self,
        matches: impl Iterator<Item = &'m Match> + Clone,
        width_z1: f64,
        cutoff_z1: f64,
        max_iterations: usize,
    ) -> Self {
        Self::of(&refine_over(matches, &self.pose, width_z1, cutoff_z1, max_iterations).second_from_first)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{UnitQuaternion, Vector2};

    #[test]
    fn a_match_costs_what_separates_it_from_a_point_in_front() {
        let forward = RelativePose { rotation: UnitQuaternion::identity(), direction: -Vector3::z() };
        let hypothesis = Hypothesis::of(&forward);
        let limit2: f64 = 1e-4;
        let agrees = |first: [f64; 2], second: [f64; 2]| {
            let m = Match { first_z1: Vector2::from(first), second_z1: Vector2::from(second) };
            hypothesis.squared_distance(&m, limit2) < limit2
        };
        // Points flow away from the epipole, which is the centre.
        assert!(agrees([0.2, 0.1], [0.3, 0.15]), "in front");
        assert!(!agrees([0.2, 0.1], [0.3, 0.25]), "off the line");
        assert!(!agrees([0.3, 0.15], [0.2, 0.1]), "behind, on the line");
        assert!(agrees([0.2, 0.1], [0.199, 0.0995]), "as good as at infinity");
        assert!(!agrees([0.2, 0.1], [-0.2, -0.1]), "beyond the epipole");
    }
}
