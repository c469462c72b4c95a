//! Relative pose error: how wrong the motion over a fixed number of frames is.

use crate::associate::PosePair;

/// Root mean squared errors of the relative motions.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rpe {
    /// Length of the error's translation, m.
    pub translation_rmse_m: f64,
    /// Angle of the error's rotation, degrees.
    pub rotation_rmse_deg: f64,
    /// How many motions were judged.
    pub n: usize,
}

/// RPE over all pairs of poses that are `delta` apart; no alignment, no change of scale. `None` when there
/// is no such pair.
///
/// # Source
/// Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", eq. 2.
pub fn rpe(pairs: &[PosePair], delta: usize) -> Option<Rpe> {
    let (mut n, mut sum_m2, mut sum_rad2) = (0, 0.0, 0.0);
    for (first, last) in pairs.iter().zip(pairs.iter().skip(delta)) {
        let truth = first.truth_from_camera.inv_mul(&last.truth_from_camera);
        let estimate = first.estimate_from_camera.inv_mul(&last.estimate_from_camera);
        let error = truth.inv_mul(&estimate);
        n += 1;
        sum_m2 += error.translation.vector.norm_squared();
        sum_rad2 += error.rotation.angle().powi(2);
    }
    (n > 0).then(|| Rpe {
        translation_rmse_m: (sum_m2 / n as f64).sqrt(),
        rotation_rmse_deg: (sum_rad2 / n as f64).sqrt().to_degrees(),
        n,
    })
}
