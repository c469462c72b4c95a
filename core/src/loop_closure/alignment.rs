//! Where the odometry's frame stands in the map, without jumps.

use crate::conventions::{Rigid, Similarity};
use crate::math::sim3::{self, Tangent7};

/// How far the camera may move in the map from one frame to the next because the map was corrected.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlignmentLimits {
    /// Rotation, rad. Above 0.
    pub rotation_rad: f64,
    /// Translation, m. Above 0.
    pub translation_m: f64,
    /// Logarithm of the scale. Above 0.
    pub log_scale: f64,
}

impl AlignmentLimits {
    /// Ours: less than odometry itself is off by per frame, and ten metres are made up for in half a minute at 10 Hz.
    pub const STANDARD: Self = Self { rotation_rad: 2e-3, translation_m: 0.03, log_scale: 1e-3 };
}

/// `map_from_odometry`, which follows corrections of the map in bounded steps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MapAlignment {
    map_from_odometry: Similarity,
    limits: AlignmentLimits,
}

impl MapAlignment {
    /// Begins at `map_from_odometry`: the identity, where the map begins with the drive.
    pub fn new(map_from_odometry: Similarity, limits: AlignmentLimits) -> Self {
        Self { map_from_odometry, limits }
    }

    /// What is published with the newest frame.
    pub fn map_from_odometry(&self) -> Similarity {
        self.map_from_odometry
    }

    /// One frame later: moves towards `wanted`, on the shortest way that the camera can take.
    ///
    /// # Inputs
    /// * `wanted`: [`LoopCloser::map_from_odometry`](super::LoopCloser::map_from_odometry), however old.
    ///
    /// # Output
    /// The new `map_from_odometry`: where it puts this camera differs from where the one before would have put it by no more
    /// than the limits. What is not finite is not followed.
    pub fn follow(&mut self, wanted: &Similarity, odometry_from_camera: &Rigid) -> Similarity {
        let odometry_from_camera = Similarity::from_isometry(*odometry_from_camera, 1.0);
        let now = self.map_from_odometry * odometry_from_camera;
        let way = sim3::log(&(now.inverse() * (wanted * odometry_from_camera)));
        let AlignmentLimits { rotation_rad, translation_m, log_scale } = self.limits;
        let moved_m = way.fixed_rows::<3>(3).norm() * self.map_from_odometry.scaling();
        let parts =
            [way.fixed_rows::<3>(0).norm() / rotation_rad, moved_m / translation_m, way[6].abs() / log_scale, 1.0];
        let steps = parts.into_iter().fold(0.0, f64::max);
        if way.iter().all(|x: &f64| x.is_finite()) {
            let step: Tangent7 = way / steps;
            self.map_from_odometry = now * sim3::exp(&step) * odometry_from_camera.inverse();
            self.map_from_odometry.isometry.rotation.renormalize();
        }
        self.map_from_odometry
    }
}
