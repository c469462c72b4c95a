//! The error measure of the KITTI odometry benchmark: drift over stretches of fixed length.

use crate::associate::PosePair;

/// Drift, averaged over all stretches of all lengths.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SegmentErrors {
    /// Translation error in percent of the length driven.
    pub translation_percent: f64,
    /// Rotation error, degrees per 100 m driven.
    pub rotation_deg_per_100m: f64,
    /// How many stretches were judged.
    pub n: usize,
}

/// Lengths of the stretches, m.
pub const LENGTHS_M: [f64; 8] = [100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0];

/// A stretch starts at every tenth pose.
const START_STEP: usize = 10;

/// KITTI segment errors without any alignment; `None` when the true path is shorter than the shortest stretch.
///
/// A stretch ends at the first pose whose true distance driven exceeds the length.
///
/// # Source
/// Geiger, Lenz & Urtasun 2012, "Are we ready for autonomous driving? The KITTI vision benchmark suite",
/// section 3.1. Own implementation.
pub fn segment_errors(pairs: &[PosePair]) -> Option<SegmentErrors> {
    let driven_m = distance_driven_m(pairs);
    let (mut n, mut sum_translation, mut sum_rotation) = (0, 0.0, 0.0);
    for start in (0..pairs.len()).step_by(START_STEP) {
        for length_m in LENGTHS_M {
            let end = driven_m.partition_point(|&d| d <= driven_m[start] + length_m);
            let Some(last) = pairs.get(end) else { break };
            let first = &pairs[start];
            let truth = first.truth_from_camera.inv_mul(&last.truth_from_camera);
            let estimate = first.estimate_from_camera.inv_mul(&last.estimate_from_camera);
            let error = estimate.inv_mul(&truth);
            n += 1;
            sum_translation += error.translation.vector.norm() / length_m;
            sum_rotation += error.rotation.angle() / length_m;
        }
    }
    (n > 0).then(|| SegmentErrors {
        translation_percent: 100.0 * sum_translation / n as f64,
        rotation_deg_per_100m: 100.0 * (sum_rotation / n as f64).to_degrees(),
        n,
    })
}

/// True distance driven up to each pose, m.
pub fn distance_driven_m(pairs: &[PosePair]) -> Vec<f64> {
    let mut driven_m = 0.0;
    let mut previous = None;
    pairs
        .iter()
        .map(|pair| {
            let center = pair.center_in_truth();
            driven_m += previous.map_or(0.0, |last| nalgebra::distance(&last, &center));
            previous = Some(center);
            driven_m
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Isometry3;

    fn straight(n: usize, step_m: f64, scale: f64) -> Vec<PosePair> {
        let at = |z: f64| Isometry3::translation(0.0, 0.0, z);
        let pair = |k: usize| PosePair {
            estimate_from_camera: at(scale * step_m * k as f64),
            truth_from_camera: at(step_m * k as f64),
        };
        (0..n).map(pair).collect()
    }

    #[test]
    fn a_wrong_scale_is_a_drift_of_that_many_percent() {
        let check = |n: usize, scale: f64, expected: Option<(f64, usize)>| {
            let found = segment_errors(&straight(n, 1.0, scale));
            assert_eq!(found.map(|f| f.n), expected.map(|(_, n)| n));
            if let (Some(found), Some((percent, _))) = (found, expected) {
                assert!((found.translation_percent - percent).abs() < 1e-9, "{found:?}");
                assert!(found.rotation_deg_per_100m < 1e-9, "{found:?}");
            }
        };
        // 101 m are driven after the first pose beyond 100 m: 1.01 of the nominal error.
        check(111, 0.9, Some((10.1, 1)));
        check(112, 0.9, Some((10.1, 2)));
        check(112, 1.0, Some((0.0, 2)));
        check(101, 0.9, None);
        check(0, 0.9, None);
    }
}
