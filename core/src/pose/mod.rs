//! Where the second camera stood: from matches alone, or from matches with known depth.
//!
//! [`estimate_relative`] needs nothing but matches and leaves the length of the step open; [`estimate_pnp`]
//! needs landmarks and returns metres; [`estimate_similarity`] needs depths in both views and returns their scale too; [`estimate_homography`] is for what leaves even the direction open, a plane or a
//! mere turn, and [`gric_essential`] against [`gric_homography`] tells which it is. All are robust, seeded and free of
//! the heap.

mod damped;
mod epnp;
mod essential;
mod five_point;
mod gric;
mod homography;
mod hypothesis;
mod local;
mod model;
mod p3p;
mod pnp;
mod polynomial;
mod refine_pose;
mod refine_relative;
mod refine_similarity;
mod robust;
mod similarity;
mod step_length;
mod triangulate;
mod turn;

pub use epnp::epnp;
pub use essential::{RelativePose, decompose_essential, essential_of, sampson_distance};
pub use five_point::five_point;
pub use gric::{gric_essential, gric_homography};
pub use homography::{
    HomographyEstimate, HomographySettings, estimate_homography, four_point, rotation_of_homography,
    squared_transfer_distance,
};
pub use p3p::p3p;
pub use pnp::{PnpEstimate, PnpSettings, TooFewLandmarks, estimate_pnp};
pub use polynomial::real_roots;
pub use refine_pose::{LandmarkMatch, PoseRefinement, refine_pose};
pub use refine_relative::{RelativeRefinement, refine_relative, relative_covariance};
pub use refine_similarity::{SimilarityRefinement, refine_similarity};
pub use robust::{RelativeEstimate, RelativeSettings, TooFewMatches, estimate_relative, trials_needed};
pub use similarity::{
    NoSimilarity, PointMatch, PointSighting, SimilarityEstimate, SimilaritySettings, align_similarity,
    estimate_similarity,
};
pub use step_length::{StepLength, fit_step_length};
pub use triangulate::{InverseDepth, Sighting, triangulate_inverse_depth};
pub use turn::fit_turn;

use nalgebra::Vector2;

/// One scene point seen by two cameras, on the plane z = 1 of each.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Match {
    /// In the first camera.
    pub first_z1: Vector2<f64>,
    /// In the second camera.
    pub second_z1: Vector2<f64>,
}

/// Why an iteration ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stop {
    /// The last step was negligible.
    Converged,
    /// The allowed number of iterations was used up.
    StepLimit,
    /// No step lowers the cost, or the equations are singular.
    Stalled,
}
