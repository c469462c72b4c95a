//! The similarity or rigid motion that brings two point sets as close together as they come.

use nalgebra::{Matrix3, Point3, Rotation3, Vector3};

/// Whether the alignment may change the size of the estimate.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Freedom {
    /// Rotation and translation: errors of metric scale stay visible.
    Se3,
    /// Rotation, translation and scale.
    Sim3,
}

/// `x_truth = scale * rotation * x_estimate + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Alignment {
    /// Factor from the estimate's lengths to the truth's; 1 under [`Freedom::Se3`].
    pub scale: f64,
    /// Rotation.
    pub truth_from_estimate: Rotation3<f64>,
    /// Translation, m.
    pub translation_m: Vector3<f64>,
}

impl Alignment {
    /// A point of the estimate in the truth's world.
    pub fn apply(&self, in_estimate: &Point3<f64>) -> Point3<f64> {
        self.truth_from_estimate * in_estimate * self.scale + self.translation_m
    }
}

/// Least-squares alignment of pairs `(in_estimate, in_truth)`.
///
/// `None` without points, or when scale is asked for and all points of the estimate are in one place. Points
/// on a line leave the turn about that line open; the residuals do not depend on it.
///
/// # Source
/// Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns",
/// eq. 34-43. Own implementation.
pub fn align(pairs: impl Iterator<Item = (Point3<f64>, Point3<f64>)> + Clone, freedom: Freedom) -> Option<Alignment> {
    let mut n = 0.0;
    let (mut sum_estimate, mut sum_truth) = (Vector3::zeros(), Vector3::zeros());
    for (in_estimate, in_truth) in pairs.clone() {
        n += 1.0;
        sum_estimate += in_estimate.coords;
        sum_truth += in_truth.coords;
    }
    if n == 0.0 {
        return None;
    }
    let (mean_estimate, mean_truth) = (sum_estimate / n, sum_truth / n);

    let mut covariance = Matrix3::zeros();
    let mut variance_estimate = 0.0;
    for (in_estimate, in_truth) in pairs {
        let from_mean = in_estimate.coords - mean_estimate;
        covariance += (in_truth.coords - mean_truth) * from_mean.transpose() / n;
        variance_estimate += from_mean.norm_squared() / n;
    }

    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mut signs = Vector3::new(1.0, 1.0, 1.0);
    if u.determinant() * v_t.determinant() < 0.0 {
        signs.z = -1.0;
    }
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let scale = match freedom {
        Freedom::Se3 => 1.0,
        Freedom::Sim3 if variance_estimate > 0.0 => svd.singular_values.dot(&signs) / variance_estimate,
        Freedom::Sim3 => return None,
    };
    Some(Alignment {
        scale,
        truth_from_estimate: Rotation3::from_matrix_unchecked(rotation),
        translation_m: mean_truth - rotation * mean_estimate * scale,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn aligned(points: &[[f64; 3]], scale: f64, freedom: Freedom) -> Option<(Alignment, f64)> {
        let truth_from_estimate = Rotation3::from_euler_angles(0.3, -0.8, 2.0);
        let pairs = points.iter().map(|&p| {
            let in_estimate = Point3::from(p);
            (in_estimate, truth_from_estimate * in_estimate * scale + Vector3::new(4.0, 5.0, -6.0))
        });
        let alignment = align(pairs.clone(), freedom)?;
        let worst_m = pairs.map(|(e, t)| (alignment.apply(&e) - t).norm()).fold(0.0, f64::max);
        Some((alignment, worst_m))
    }

    const SPREAD: [[f64; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 3.0], [2.0, -1.0, 7.0], [0.5, 0.3, 9.0]];

    #[test]
    fn a_known_similarity_is_found_again() {
        let (alignment, worst_m) = aligned(&SPREAD, 1.7, Freedom::Sim3).expect("alignment");
        assert!((alignment.scale - 1.7).abs() < 1e-12 && worst_m < 1e-12, "{alignment:?} {worst_m}");
        let (rigid, worst_m) = aligned(&SPREAD, 1.0, Freedom::Se3).expect("alignment");
        assert!(rigid.scale == 1.0 && worst_m < 1e-12, "{rigid:?} {worst_m}");
        let (_, worst_m) = aligned(&SPREAD, 1.7, Freedom::Se3).expect("alignment");
        assert!(worst_m > 1.0, "a rigid alignment must not hide a wrong scale: {worst_m}");
    }

    #[test]
    fn points_on_a_line_or_in_one_place_are_judged_too() {
        let line = [[0.0, 0.0, 0.0], [0.0, 0.0, 2.0], [0.0, 0.0, 5.0]];
        let (alignment, worst_m) = aligned(&line, 0.8, Freedom::Sim3).expect("alignment");
        assert!((alignment.scale - 0.8).abs() < 1e-12 && worst_m < 1e-12, "{alignment:?} {worst_m}");
        let place = [[1.0, 2.0, 3.0]; 3];
        assert!(aligned(&place, 1.0, Freedom::Sim3).is_none());
        assert!(aligned(&place, 1.0, Freedom::Se3).is_some_and(|(_, worst_m)| worst_m < 1e-12));
    }

    #[test]
    fn a_mirror_image_is_not_turned_into_a_reflection() {
        let pairs = SPREAD.iter().map(|&[x, y, z]| (Point3::new(x, y, z), Point3::new(-x, y, z)));
        let alignment = align(pairs, Freedom::Sim3).expect("alignment");
        assert!((alignment.truth_from_estimate.matrix().determinant() - 1.0).abs() < 1e-12);
    }
}
