//! Which model two views call for: that of a moving camera, or the homography that a plane or a mere turn leaves.

use super::hypothesis::Hypothesis;
use super::model::Model;
use super::{Match, RelativePose, squared_transfer_distance};
use nalgebra::Matrix3;

/// Dimensions of a match: two coordinates in two views.
const DATA: f64 = 4.0;

/// Geometric robust information criterion: the lower, the better the model explains the matches for its freedom.
///
/// sum_i min(e_i^2 / sigma^2, 2 (r - d)) + ln(r) d n + ln(r n) k
fn gric(squared_distances: impl Iterator<Item = f64>, n: usize, sigma_z1: f64, dimension: f64, parameters: f64) -> f64 {
    let (n, limit) = (n as f64, 2.0 * (DATA - dimension));
    let misfit: f64 = squared_distances.map(|d2| (d2 / (sigma_z1 * sigma_z1)).min(limit)).sum();
    misfit + libm::log(DATA) * dimension * n + libm::log(DATA * n.max(1.0)) * parameters
}

/// GRIC of a moving camera: matches lie on a manifold of dimension 3, the motion has 5 parameters.
///
/// # Inputs
/// * `motion`: e.g. of [`estimate_relative`](super::estimate_relative).
/// * `matches`: those that one model or the other explains, the same for both. An outlier of both costs a homography
///   0.6 more than a motion, so that a third of outliers would decide for the motion.
/// * `sigma_z1`: noise of a match per axis, on the plane z = 1.
///
/// # Output
/// To be compared with [`gric_homography`] of the same matches.
///
/// # Cost
/// O(n).
///
/// # Source
/// Torr 1998, "Geometric motion segmentation and model selection", eq. 6. Own implementation.
pub fn gric_essential(motion: &RelativePose, matches: &[Match], sigma_z1: f64) -> f64 {
    let hypothesis = Hypothesis::of(motion);
    let limit2 = 2.0 * (DATA - 3.0) * sigma_z1 * sigma_z1;
    gric(matches.iter().map(|m| hypothesis.squared_distance(m, limit2)), matches.len(), sigma_z1, 3.0, 5.0)
}

/// GRIC of a homography: matches lie on a manifold of dimension 2, the homography has 8 parameters.
///
/// # Inputs
/// As for [`gric_essential`], with the homography of [`estimate_homography`](super::estimate_homography).
///
/// # Output
/// Not above [`gric_essential`] of the same matches: the views fix no direction of motion.
///
/// # Cost
/// O(n).
///
/// # Source
/// Torr 1998, eq. 6. Own implementation.
pub fn gric_homography(second_from_first: &Matrix3<f64>, matches: &[Match], sigma_z1: f64) -> f64 {
    let distances2 = matches.iter().map(|m| squared_transfer_distance(second_from_first, m));
    gric(distances2, matches.len(), sigma_z1, 2.0, 8.0)
}
