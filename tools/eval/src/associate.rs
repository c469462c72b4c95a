//! Which pose of the estimate belongs to which pose of the truth.

use crate::trajectory::StampedPose;
use nalgebra::{Isometry3, Point3};

/// An estimated pose beside the true one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PosePair {
    /// The estimate.
    pub estimate_from_camera: Isometry3<f64>,
    /// The truth.
    pub truth_from_camera: Isometry3<f64>,
}

impl PosePair {
    /// Camera centre in the estimate's world, m.
    pub fn center_in_estimate(&self) -> Point3<f64> {
        self.estimate_from_camera.translation.vector.into()
    }

    /// Camera centre in the truth's world, m.
    pub fn center_in_truth(&self) -> Point3<f64> {
        self.truth_from_camera.translation.vector.into()
    }
}

/// Largest difference of two times that mean the same moment.
pub const MAX_TIME_DIFFERENCE_S: f64 = 0.01;

/// Pairs up two trajectories by time: each pose of the shorter one with the nearest of the longer one, when
/// they are at most [`MAX_TIME_DIFFERENCE_S`] apart. Both are in the order of time.
pub fn by_time(estimate: &[StampedPose], truth: &[StampedPose]) -> Vec<PosePair> {
    let pair = |estimate: &StampedPose, truth: &StampedPose| PosePair {
        estimate_from_camera: estimate.world_from_camera,
        truth_from_camera: truth.world_from_camera,
    };
    if estimate.len() <= truth.len() {
        estimate.iter().filter_map(|e| nearest(truth, e.time_s).map(|t| pair(e, t))).collect()
    } else {
        truth.iter().filter_map(|t| nearest(estimate, t.time_s).map(|e| pair(e, t))).collect()
    }
}

fn nearest(poses: &[StampedPose], time_s: f64) -> Option<&StampedPose> {
    let after = poses.partition_point(|pose| pose.time_s < time_s);
    let candidates = [after.checked_sub(1), Some(after)];
    candidates
        .into_iter()
        .filter_map(|idx| poses.get(idx?))
        .min_by(|a, b| (a.time_s - time_s).abs().total_cmp(&(b.time_s - time_s).abs()))
        .filter(|pose| (pose.time_s - time_s).abs() <= MAX_TIME_DIFFERENCE_S)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(times_s: &[f64]) -> Vec<StampedPose> {
        let pose = |&time_s: &f64| StampedPose { time_s, world_from_camera: Isometry3::translation(time_s, 0.0, 0.0) };
        times_s.iter().map(pose).collect()
    }

    #[test]
    fn each_pose_of_the_shorter_side_meets_its_nearest() {
        let check = |estimate: &[f64], truth: &[f64], expected: &[(f64, f64)]| {
            let pairs = by_time(&at(estimate), &at(truth));
            let found: Vec<_> = pairs.iter().map(|p| (p.center_in_estimate().x, p.center_in_truth().x)).collect();
            assert_eq!(found, expected);
        };
        check(&[1.0, 2.004, 3.02], &[1.0, 2.0, 3.0, 4.0], &[(1.0, 1.0), (2.004, 2.0)]);
        check(&[0.993, 1.004, 2.0], &[1.0, 2.0], &[(1.004, 1.0), (2.0, 2.0)]);
        check(&[5.0], &[1.0, 2.0], &[]);
        check(&[], &[1.0], &[]);
    }
}
