//! Absolute trajectory error: how far the camera centres are from the truth after one alignment of the whole.

use crate::align::{Alignment, Freedom, align};
use crate::associate::PosePair;

/// The error and the alignment under which it was taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ate {
    /// Root of the mean squared distance, m.
    pub rmse_m: f64,
    /// Largest distance, m.
    pub max_m: f64,
    /// What brought the estimate onto the truth.
    pub alignment: Alignment,
}

/// ATE of paired poses; `None` where the alignment is not defined (see [`align`]).
///
/// # Source
/// Sturm et al. 2012, "A benchmark for the evaluation of RGB-D SLAM systems", section V-B.
pub fn ate(pairs: &[PosePair], freedom: Freedom) -> Option<Ate> {
    let centers = pairs.iter().map(|pair| (pair.center_in_estimate(), pair.center_in_truth()));
    let alignment = align(centers.clone(), freedom)?;
    let (mut sum_squared, mut max_m) = (0.0, 0.0_f64);
    for (in_estimate, in_truth) in centers {
        let distance_m = (alignment.apply(&in_estimate) - in_truth).norm();
        sum_squared += distance_m * distance_m;
        max_m = max_m.max(distance_m);
    }
    Some(Ate { rmse_m: (sum_squared / pairs.len() as f64).sqrt(), max_m, alignment })
}
