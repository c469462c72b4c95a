//! The essential matrix and the motions behind it.

use super::Match;
use crate::math::se3::skew;
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

/// Rotation and direction of a step whose length is unknown.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RelativePose {
    /// Rotation of `second_from_first`.
    pub rotation: UnitQuaternion<f64>,
    /// Translation of `second_from_first` divided by its length.
    pub direction: Vector3<f64>,
}

/// Essential matrix `[t]x R` of a motion: `second^T E first = 0`.
///
/// # Source
/// Hartley & Zisserman 2004, eq. 9.12.
pub fn essential_of(second_from_first: &RelativePose) -> Matrix3<f64> {
    skew(&second_from_first.direction) * second_from_first.rotation.to_rotation_matrix().matrix()
}

/// First-order distance of a match from the epipolar constraint, in units of the plane z = 1, signed.
///
/// # Output
/// 0 for a match at both epipoles, where the constraint says nothing.
///
/// # Source
/// Hartley & Zisserman 2004, eq. 11.9 (its square is the Sampson error).
pub fn sampson_distance(essential: &Matrix3<f64>, m: &Match) -> f64 {
    let first = Vector3::new(m.first_z1.x, m.first_z1.y, 1.0);
    let second = Vector3::new(m.second_z1.x, m.second_z1.y, 1.0);
    let line_in_second = essential * first;
    let line_in_first = essential.tr_mul(&second);
    let gradient2 = line_in_second.xy().norm_squared() + line_in_first.xy().norm_squared();
    if gradient2 > 0.0 { second.dot(&line_in_second) / libm::sqrt(gradient2) } else { 0.0 }
}

/// The four motions that share one essential matrix; `None` when it is not finite or zero.
///
/// # Source
/// Hartley & Zisserman 2004, result 9.19; the singular vectors are found as in Horn 1990, "Recovering baseline
/// and orientation from essential matrix", from cross products instead of a decomposition.
pub fn decompose_essential(essential: &Matrix3<f64>) -> Option<[RelativePose; 4]> {
    let columns = [essential.column(0), essential.column(1), essential.column(2)];
    // The left null vector is orthogonal to all columns.
    let crossings = [columns[0].cross(&columns[1]), columns[1].cross(&columns[2]), columns[2].cross(&columns[0])];
    let longest = crossings.into_iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    let scale = libm::sqrt(0.5) * essential.norm();
    if !scale.is_finite() || scale == 0.0 || longest.norm_squared() == 0.0 {
        return None;
    }
    let direction = longest.normalize();
    let unit = essential / scale;
    // Horn's eq. for a unit baseline b: R = cofactors(E) - [b]x E.
    let cofactors = Matrix3::from_columns(&[
        unit.column(1).cross(&unit.column(2)),
        unit.column(2).cross(&unit.column(0)),
        unit.column(0).cross(&unit.column(1)),
    ]);
    let rotation = |sign: f64| {
        let matrix = cofactors - skew(&direction) * unit * sign;
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(matrix))
    };
    let (one, other) = (rotation(1.0), rotation(-1.0));
    Some([
        RelativePose { rotation: one, direction },
        RelativePose { rotation: one, direction: -direction },
        RelativePose { rotation: other, direction },
        RelativePose { rotation: other, direction: -direction },
    ])
}

impl RelativePose {
    /// Whether the match's point lies in front of both cameras. There is no upper bound on its depth: far
    /// points have noisy depth but carry the rotation.
    pub fn in_front_of_both(&self, m: &Match) -> bool {
        // x2 ~ d1 R x1 + t: cross with x2 for d1, with R x1 for d2.
        let rotated = self.rotation * Vector3::new(m.first_z1.x, m.first_z1.y, 1.0);
        let second = Vector3::new(m.second_z1.x, m.second_z1.y, 1.0);
        let normal = rotated.cross(&second);
        normal.dot(&second.cross(&self.direction)) > 0.0 && normal.dot(&rotated.cross(&self.direction)) > 0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;

    fn motion() -> RelativePose {
        RelativePose {
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.05, -0.3, 0.02)),
            direction: Vector3::new(0.3, -0.1, -0.9).normalize(),
        }
    }

    fn seen(point_in_first: Vector3<f64>, m: &RelativePose) -> Match {
        let q = m.rotation * point_in_first + m.direction;
        Match { first_z1: (point_in_first / point_in_first.z).xy(), second_z1: (q / q.z).xy() }
    }

    #[test]
    fn one_of_four_decompositions_is_the_motion_and_only_it_sees_the_point() {
        let truth = motion();
        for scale in [1.0, -3.0, 1e-3] {
            let four = decompose_essential(&(essential_of(&truth) * scale)).expect("finite");
            let point = seen(Vector3::new(1.0, 0.5, 12.0), &truth);
            let in_front: std::vec::Vec<_> = four.iter().filter(|c| c.in_front_of_both(&point)).collect();
            assert_eq!(in_front.len(), 1);
            assert!(in_front[0].rotation.angle_to(&truth.rotation) < 1e-9);
            assert!((in_front[0].direction - truth.direction).norm() < 1e-9);
        }
        assert_eq!(decompose_essential(&Matrix3::zeros()), None);
        assert_eq!(decompose_essential(&Matrix3::from_element(f64::NAN)), None);
    }

    #[test]
    fn points_far_beyond_the_baseline_still_count_as_in_front() {
        let truth = motion();
        assert!(truth.in_front_of_both(&seen(Vector3::new(500.0, 100.0, 20_000.0), &truth)));
        let behind = seen(Vector3::new(1.0, 0.5, -12.0), &truth);
        assert!(!truth.in_front_of_both(&behind));
    }

    #[test]
    fn a_match_off_by_a_pixel_has_a_distance_of_about_a_pixel() {
        let truth = motion();
        let exact = seen(Vector3::new(1.0, 0.5, 6.0), &truth);
        let essential = essential_of(&truth);
        assert!(sampson_distance(&essential, &exact).abs() < 1e-12);
        let line = essential * Vector3::new(exact.first_z1.x, exact.first_z1.y, 1.0);
        let off: Vector2<f64> = line.xy().normalize() * 1e-3;
        let moved = Match { second_z1: exact.second_z1 + off, ..exact };
        let distance = sampson_distance(&essential, &moved).abs();
        assert!((0.6e-3..0.8e-3).contains(&distance), "{distance}: shared between the two views");
    }
}
