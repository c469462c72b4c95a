//! The homography of two views: of a plane, or of a camera that only turns.

use super::damped::Descent;
use super::model::{MAX_SOLUTIONS, Model, search};
use super::refine_relative::cauchy;
use super::{Match, RelativeSettings, TooFewMatches};
use crate::math::Rng;
use heapless::Vec;
use nalgebra::{Matrix2, Matrix3, Rotation3, SMatrix, SVector, UnitQuaternion, Vector2, Vector3};

/// How hard [`estimate_homography`] tries.
pub type HomographySettings = RelativeSettings;

/// A homography with the evidence for it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct HomographyEstimate {
    /// `second ~ H first` on the planes z = 1, of determinant one.
    pub second_from_first: Matrix3<f64>,
    /// Matches within the inlier distance.
    pub n_inliers: usize,
    /// Samples drawn.
    pub n_trials: usize,
}

const SAMPLE_SIZE: usize = 4;
const FIRST_DAMPING: f64 = 1e-3;
/// Three points whose triangle is flatter than this fix no frame.
const MIN_DETERMINANT: f64 = 1e-9;
const NEAREST_ROTATION_STEPS: usize = 50;

fn homogeneous(point_z1: &Vector2<f64>) -> Vector3<f64> {
    Vector3::new(point_z1.x, point_z1.y, 1.0)
}

/// The frame of four points: a matrix that takes the unit vectors to multiples of the first three points and
/// (1, 1, 1) to the fourth. Its multiples come along.
fn frame_of(points: &[Vector3<f64>; 4]) -> Option<(Matrix3<f64>, Vector3<f64>)> {
    let [a, b, c, d] = points;
    let three = Matrix3::from_columns(&[*a, *b, *c]);
    if three.determinant().abs() < MIN_DETERMINANT {
        return None;
    }
    let multiples = three.try_inverse()? * d;
    Some((three * Matrix3::from_diagonal(&multiples), multiples))
}

/// The homography that four matches determine, of determinant one.
///
/// # Output
/// `None` where three points are nearly on a line in either view, or where the cameras would have to be on two sides of
/// the plane.
///
/// # Cost
/// Constant.
///
/// # Source
/// Hartley & Zisserman 2004, sec. 2.3 (projective frames); the test of orientation is Chum, Werner & Matas 2004,
/// "Epipolar geometry estimation via RANSAC benefits from the oriented epipolar constraint", for points. Own
/// implementation.
pub fn four_point(sample: &[Match; SAMPLE_SIZE]) -> Option<Matrix3<f64>> {
    let (from_first, first) = frame_of(&sample.map(|m| homogeneous(&m.first_z1)))?;
    let (to_second, second) = frame_of(&sample.map(|m| homogeneous(&m.second_z1)))?;
    if first.component_mul(&second).min() <= 0.0 {
        return None;
    }
    of_unit_determinant(&(to_second * from_first.try_inverse()?))
}

fn of_unit_determinant(homography: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let determinant = homography.determinant();
    let scaled = homography / libm::cbrt(determinant);
    (determinant > 0.0 && scaled.iter().all(|v| v.is_finite())).then_some(scaled)
}

/// Algebraic error of a match, and its covariance for unit noise of all four coordinates; `None` behind a camera.
fn algebraic(homography: &Matrix3<f64>, m: &Match) -> Option<(Vector2<f64>, Matrix2<f64>, Vector3<f64>)> {
    let p = homography * homogeneous(&m.first_z1);
    if p.z.is_nan() || p.z <= 0.0 {
        return None;
    }
    let h = homography;
    let by_first = Matrix2::new(
        h.m11 - h.m31 * m.second_z1.x,
        h.m12 - h.m32 * m.second_z1.x,
        h.m21 - h.m31 * m.second_z1.y,
        h.m22 - h.m32 * m.second_z1.y,
    );
    let covariance = by_first * by_first.transpose() + Matrix2::identity() * (p.z * p.z);
    Some((p.xy() - m.second_z1 * p.z, covariance, p))
}

/// Squared first-order distance of a match from agreement with `second ~ H first`, over both views, on the plane z = 1.
///
/// # Output
/// Infinite where the first point would lie behind the second camera.
///
/// # Cost
/// Constant.
///
/// # Source
/// Hartley & Zisserman 2004, sec. 4.2.6 (Sampson error).
pub fn squared_transfer_distance(homography: &Matrix3<f64>, m: &Match) -> f64 {
    let Some((error, covariance, _)) = algebraic(homography, m) else { return f64::INFINITY };
    covariance.try_inverse().map_or(f64::INFINITY, |inverse| error.dot(&(inverse * error)))
}

/// Increments are the entries of `X` in `(I + X) H` but the last, which would change the scale.
struct HomographyProblem<I> {
    matches: I,
    width2: f64,
    cutoff2: f64,
}

impl<'m, I: Iterator<Item = &'m Match> + Clone> Descent<8> for HomographyProblem<I> {
    type State = Matrix3<f64>;

    fn cost(&self, at: &Matrix3<f64>) -> f64 {
        let distances2 = self.matches.clone().map(|m| squared_transfer_distance(at, m));
        distances2.map(|d2| cauchy(d2.min(self.cutoff2), self.width2).0).sum()
    }

    fn normal_equations(&self, at: &Matrix3<f64>) -> (SMatrix<f64, 8, 8>, SVector<f64, 8>) {
        let (mut hessian, mut gradient) = (SMatrix::zeros(), SVector::zeros());
        for m in self.matches.clone() {
            let Some((error, covariance, p)) = algebraic(at, m) else { continue };
            let Some(inverse) = covariance.try_inverse() else { continue };
            let d2 = error.dot(&(inverse * error));
            if d2 < self.cutoff2 {
                let (x, y) = (m.second_z1.x, m.second_z1.y);
                let by_step = SMatrix::<f64, 2, 8>::from_row_slice(&[
                    p.x,
                    p.y,
                    p.z,
                    0.0,
                    0.0,
                    0.0,
                    -x * p.x,
                    -x * p.y, //
                    0.0,
                    0.0,
                    0.0,
                    p.x,
                    p.y,
                    p.z,
                    -y * p.x,
                    -y * p.y,
                ]);
                let weighted = by_step.tr_mul(&inverse) * cauchy(d2, self.width2).1;
                hessian += weighted * by_step;
                gradient += weighted * error;
            }
        }
        (hessian, gradient)
    }

    fn moved(&self, from: &Matrix3<f64>, step: &SVector<f64, 8>) -> Matrix3<f64> {
        let x = Matrix3::new(step[0], step[1], step[2], step[3], step[4], step[5], step[6], step[7], 0.0);
        let moved = from + x * from;
        of_unit_determinant(&moved).unwrap_or(*from)
    }
}

impl Model<SAMPLE_SIZE> for Matrix3<f64> {
    fn solve(sample: &[Match; SAMPLE_SIZE]) -> Vec<Matrix3<f64>, MAX_SOLUTIONS> {
        four_point(sample).into_iter().collect()
    }

    fn least_squared_distance(solution: &Matrix3<f64>, m: &Match) -> f64 {
        squared_transfer_distance(solution, m)
    }

    fn of_solution(solution: &Matrix3<f64>, _: &[Match; SAMPLE_SIZE]) -> Option<Self> {
        Some(*solution)
    }

    fn squared_distance(&self, m: &Match, _: f64) -> f64 {
        squared_transfer_distance(self, m)
    }

    fn refined<'m>(
        &self,
        matches: impl Iterator<Item = &'m Match> + Clone,
        width_z1: f64,
        cutoff_z1: f64,
        max_iterations: usize,
    ) -> Self {
        let (width2, cutoff2) = (width_z1 * width_z1, cutoff_z1 * cutoff_z1);
        HomographyProblem { matches, width2, cutoff2 }.descend(self, FIRST_DAMPING, max_iterations).0
    }
}

/// Estimates the homography between two views, with outliers present.
///
/// # Inputs
/// * `matches`: any order; outliers allowed.
/// * `settings`: the inlier distance is that of [`squared_transfer_distance`], over both views.
/// * `rng`: seeded by frame; same seed, same result.
///
/// # Output
/// The homography, and `is_inlier` (as long as `matches`) filled.
///
/// # Errors
/// [`TooFewMatches`] below four matches, or when no sample gave a homography.
///
/// # Cost
/// O(trials * n), cut short for bad hypotheses; 8 KiB of stack.
///
/// # Source
/// Torr & Zisserman 2000 (MSAC); Chum, Matas & Kittler 2003 (LO-RANSAC). Own implementation.
pub fn estimate_homography(
    matches: &[Match],
    settings: &HomographySettings,
    rng: &mut Rng,
    is_inlier: &mut [bool],
) -> Result<HomographyEstimate, TooFewMatches> {
    let (second_from_first, n_trials) = search::<Matrix3<f64>, SAMPLE_SIZE>(matches, None, settings, rng, is_inlier)?;
    let n_inliers = is_inlier.iter().take(matches.len()).filter(|&&is| is).count();
    Ok(HomographyEstimate { second_from_first, n_inliers, n_trials })
}

/// The rotation `second_from_first` of a camera that only turned, read from its homography.
///
/// # Output
/// The nearest rotation, and how far the homography of determinant one is from it (Frobenius norm): about the noise on
/// the plane z = 1 for a pure rotation, about baseline over distance for a plane. `None` for a singular homography.
///
/// # Cost
/// Constant.
///
/// # Source
/// Hartley & Zisserman 2004, sec. 8.4.2 (H = R for calibrated points); the nearest rotation is found as in Mueller,
/// Bender, Chentanez & Macklin 2016, "A robust method to extract the rotational part of deformations" (nalgebra).
pub fn rotation_of_homography(homography: &Matrix3<f64>) -> Option<(UnitQuaternion<f64>, f64)> {
    let h = of_unit_determinant(homography)?;
    let rotation = Rotation3::from_matrix_eps(&h, f64::EPSILON, NEAREST_ROTATION_STEPS, Rotation3::identity());
    Some((UnitQuaternion::from_rotation_matrix(&rotation), (h - rotation.matrix()).norm()))
}

#[cfg(test)]
mod tests {
    use super::super::gric::{gric_essential, gric_homography};
    use super::super::{RelativePose, estimate_relative};
    use super::*;
    use std::vec::Vec as StdVec;

    const SETTINGS: HomographySettings =
        HomographySettings { inlier_z1: 2e-3, confidence: 0.999, trials: [5, 1000], local_iterations: 10 };
    const NOISE_Z1: f64 = 1e-3;
    const N: usize = 300;

    /// What the camera sees.
    #[derive(Clone, Copy, Debug, PartialEq)]
    enum Scene {
        /// A road 1.5 m below, while the camera drives.
        Road,
        /// A town, while the camera only turns.
        Turn,
        /// A town, while the camera drives.
        Town,
    }

    fn motion() -> RelativePose {
        RelativePose {
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.01, -0.12, 0.02)),
            direction: Vector3::new(0.15, 0.02, -1.0).normalize(),
        }
    }

    fn seen(scene: Scene, outlier_ratio: f64, noise_z1: f64, seed: u64) -> StdVec<Match> {
        let mut rng = Rng::new(seed, 0, 0);
        let mut within = |half: f64| half * (2.0 * rng.unit_f64() - 1.0);
        (0..N)
            .map(|i| {
                let z = 17.0 + within(13.0);
                let y = if scene == Scene::Road { 1.5 } else { within(0.3) * z };
                let p = Vector3::new(within(0.7) * z, y, z);
                let step = if scene == Scene::Turn { Vector3::zeros() } else { motion().direction };
                let q = motion().rotation * p + step;
                let mut m = Match { first_z1: (p / p.z).xy(), second_z1: (q / q.z).xy() };
                if (i as f64) < outlier_ratio * N as f64 {
                    m.second_z1 = Vector2::new(within(0.8), within(0.3));
                }
                // The sum of three uniform numbers from -s to s has the deviation s.
                let mut noisy = |v: Vector2<f64>| v.map(|x| x + (0..3).map(|_| within(noise_z1)).sum::<f64>());
                Match { first_z1: noisy(m.first_z1), second_z1: noisy(m.second_z1) }
            })
            .collect()
    }

    fn truth(scene: Scene) -> Matrix3<f64> {
        // A point on the road has the normal (0, 1, 0) times its place equal to 1.5 m.
        let plane = if scene == Scene::Road { Vector3::y() / 1.5 } else { Vector3::zeros() };
        let h = motion().rotation.to_rotation_matrix().matrix() + motion().direction * plane.transpose();
        of_unit_determinant(&h).expect("both cameras above the road")
    }

    #[test]
    fn the_homography_survives_noise_and_outliers() {
        for (scene, outlier_ratio) in
            [(Scene::Road, 0.0), (Scene::Road, 0.3), (Scene::Road, 0.6), (Scene::Turn, 0.0), (Scene::Turn, 0.6)]
        {
            let matches = seen(scene, outlier_ratio, NOISE_Z1, 1);
            let mut is_inlier = [false; N];
            let found =
                estimate_homography(&matches, &SETTINGS, &mut Rng::new(1, 2, 3), &mut is_inlier).expect("enough");
            let exact = seen(scene, outlier_ratio, 0.0, 1);
            let n_outliers = (outlier_ratio * N as f64) as usize;
            let error = |m: &Match| squared_transfer_distance(&found.second_from_first, m).sqrt();
            let worst = exact.iter().skip(n_outliers).map(error).fold(0.0, f64::max);
            assert!(worst < 1.5 * NOISE_Z1, "{scene:?}, {outlier_ratio}: off by {worst:.5}");
            // Two standard deviations of two coordinates hold 86 %.
            let expected = 0.86 * (N - n_outliers) as f64;
            assert!((found.n_inliers as f64 - expected).abs() < 0.1 * N as f64, "{scene:?}: {found:?}");
            assert_eq!(found.n_inliers, is_inlier.iter().filter(|&&i| i).count());
        }
    }

    #[test]
    fn four_exact_matches_give_the_homography_and_impossible_ones_none() {
        for scene in [Scene::Road, Scene::Turn] {
            let mut sample: [Match; 4] = core::array::from_fn(|i| seen(scene, 0.0, 0.0, 2)[7 * i]);
            let found = four_point(&sample).expect("no three on a line");
            assert!((found - truth(scene)).norm() < 1e-9, "{found} {}", truth(scene));
            sample.swap(0, 1);
            assert_eq!(four_point(&[sample[0], sample[0], sample[1], sample[2]]), None, "a point twice");
            let mirrored =
                sample.map(|m| Match { first_z1: m.first_z1, second_z1: Vector2::new(-m.second_z1.x, m.second_z1.y) });
            assert_eq!(four_point(&mirrored), None, "seen from behind");
        }
    }

    #[test]
    fn a_turn_is_read_from_its_homography() {
        let matches = seen(Scene::Turn, 0.3, NOISE_Z1, 3);
        let found = estimate_homography(&matches, &SETTINGS, &mut Rng::new(1, 2, 3), &mut [false; N]).expect("enough");
        let (rotation, off) = rotation_of_homography(&found.second_from_first).expect("regular");
        assert!(rotation.angle_to(&motion().rotation) < 5e-4, "{}", rotation.angle_to(&motion().rotation));
        assert!(off < 5e-3, "{off}");
        let (_, off) = rotation_of_homography(&truth(Scene::Road)).expect("regular");
        assert!(off > 0.3, "{off}");
        assert_eq!(rotation_of_homography(&Matrix3::zeros()), None);
    }

    #[test]
    fn the_criterion_tells_planes_and_turns_from_a_moving_camera() {
        for (scene, is_homography) in [(Scene::Road, true), (Scene::Turn, true), (Scene::Town, false)] {
            for (outlier_ratio, seed) in [(0.0, 1), (0.0, 2), (0.3, 3), (0.3, 4), (0.5, 5)] {
                let matches = seen(scene, outlier_ratio, NOISE_Z1, seed);
                let mut rng = Rng::new(seed, 2, 3);
                let (mut of_one, mut of_other) = ([false; N], [false; N]);
                let plane = estimate_homography(&matches, &SETTINGS, &mut rng, &mut of_one).expect("enough");
                let moving = estimate_relative(&matches, None, &SETTINGS, &mut rng, &mut of_other).expect("enough");
                let is_explained = of_one.iter().zip(&of_other).map(|(&a, &b)| a || b);
                let matches: StdVec<_> = matches.into_iter().zip(is_explained).filter(|m| m.1).map(|m| m.0).collect();
                let of_plane = gric_homography(&plane.second_from_first, &matches, NOISE_Z1);
                let of_moving = gric_essential(&moving.second_from_first, &matches, NOISE_Z1);
                assert_eq!(
                    of_plane <= of_moving,
                    is_homography,
                    "{scene:?}, {outlier_ratio}: {of_plane:.0}, {of_moving:.0}"
                );
            }
        }
    }

    #[test]
    fn fewer_than_four_matches_are_an_error() {
        let matches = seen(Scene::Road, 0.0, 0.0, 1);
        let error = estimate_homography(&matches[..3], &SETTINGS, &mut Rng::new(0, 0, 0), &mut [false; 3]);
        assert_eq!(error, Err(TooFewMatches { found: 3, needed: 4 }));
    }
}
