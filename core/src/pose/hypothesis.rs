//! A motion that competes, and what a match costs under it.

use super::{Match, RelativePose, decompose_essential, essential_of, sampson_distance};
use nalgebra::{Matrix3, Vector3};

/// A motion with the matrices that its cost needs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hypothesis {
    pub pose: RelativePose,
    pub essential: Matrix3<f64>,
    rotation: Matrix3<f64>,
}

/// Matches that a hypothesis is tried on before it is scored on all; the power of two of a byte.
const PROBES: usize = 256;
/// Probes between two looks at the sum.
const PROBES_PER_LOOK: usize = 16;
/// Standard deviations by which a hypothesis has to look worse than the best to be given up.
const GIVE_UP_SIGMAS: f64 = 3.0;

impl Hypothesis {
    pub fn of(pose: &RelativePose) -> Self {
        Self { pose: *pose, essential: essential_of(pose), rotation: *pose.rotation.to_rotation_matrix().matrix() }
    }

    /// Of the four motions behind an essential matrix, the one that has most of `sample` in front of both cameras.
    pub fn most_in_front(essential: &Matrix3<f64>, sample: &[Match]) -> Option<Self> {
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
    pub fn squared_distance(&self, m: &Match, limit2: f64) -> f64 {
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
}

/// A hypothesis with its truncated squared distances (MSAC).
#[derive(Clone, Copy, Debug)]
pub(super) struct Scored {
    pub hypothesis: Hypothesis,
    pub cost: f64,
    pub n_inliers: usize,
}

impl Scored {
    pub fn of(hypothesis: Hypothesis, matches: &[Match], inlier2: f64) -> Self {
        let (mut cost, mut n_inliers) = (0.0, 0);
        for m in matches {
            let r2 = hypothesis.squared_distance(m, inlier2);
            n_inliers += usize::from(r2 < inlier2);
            cost += r2.min(inlier2);
        }
        Self { hypothesis, cost, n_inliers }
    }
}

/// Whether a hypothesis may cost less than `to_beat`, told from few matches spread over all: one that does costs that
/// share of it on average, and a cost between 0 and `inlier2` deviates by half of `inlier2` at most (Popoviciu 1935).
///
/// # Source
/// The idea of Matas & Chum 2005, "Randomized RANSAC with sequential probability ratio test"; own test.
pub(super) fn may_beat(to_beat: f64, essential: &Matrix3<f64>, matches: &[Match], inlier2: f64) -> bool {
    if matches.len() < PROBES || to_beat.is_infinite() {
        return true;
    }
    let share = to_beat / matches.len() as f64;
    let mut cost = 0.0;
    for k in 0..PROBES {
        // Reversed bits visit everywhere early (van der Corput 1935): neighbours in the list are neighbours in the image.
        let place = usize::from((k as u8).reverse_bits()) * matches.len() / PROBES;
        let Some(m) = matches.get(place) else { continue };
        let r = sampson_distance(essential, m);
        cost += (r * r).min(inlier2);
        let n = (k + 1) as f64;
        let most = share * n + GIVE_UP_SIGMAS * 0.5 * inlier2 * libm::sqrt(n);
        if (k + 1) % PROBES_PER_LOOK == 0 && cost > most {
            return false;
        }
    }
    true
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
