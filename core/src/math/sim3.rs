//! Exponential, logarithm and derivatives of similarities.
//!
//! Tangent order and side of the increment: [`conventions`](crate::conventions).

use super::se3::skew;
use crate::conventions::Similarity;
use nalgebra::{Isometry3, Matrix3, SMatrix, SVector, Translation3, UnitQuaternion, Vector3};

/// A tangent vector of Sim(3): `[omega, upsilon, sigma]` (rad, m, natural logarithm of the scale).
pub type Tangent7 = SVector<f64, 7>;

/// A linear map between tangent vectors of Sim(3).
pub type Matrix7 = SMatrix<f64, 7, 7>;

/// Logarithms of scales are held within this, so that no scale becomes zero or infinite.
const MAX_LOG_SCALE: f64 = 7.0;
/// Terms of a series that are smaller than this change no digit.
const NEGLIGIBLE_TERM: f64 = 1e-18;
/// More terms than half a turn with the largest scale needs.
const MAX_TERMS: usize = 64;

/// Similarity of the tangent vector; its logarithm of the scale is held within +-7.
///
/// # Source
/// Strasdat 2012, "Local accuracy and global consistency for efficient visual SLAM", sec. 2.4.4. Own implementation;
/// differs in the series, which has no branch at small angles or scales.
pub fn exp(tangent: &Tangent7) -> Similarity {
    let (omega, upsilon, sigma) = parts(tangent);
    let sigma = sigma.clamp(-MAX_LOG_SCALE, MAX_LOG_SCALE);
    let translation = Series::of(&omega, &Vector3::zeros(), sigma).translation * upsilon;
    let rotation = UnitQuaternion::from_scaled_axis(omega);
    Similarity::from_isometry(Isometry3::from_parts(Translation3::from(translation), rotation), libm::exp(sigma))
}

/// Tangent vector of a similarity; inverse of [`exp`].
///
/// # Source
/// As [`exp`].
pub fn log(similarity: &Similarity) -> Tangent7 {
    let omega = similarity.isometry.rotation.scaled_axis();
    let sigma = libm::log(similarity.scaling());
    let translation = similarity.isometry.translation.vector;
    // Singular only at whole turns, which `scaled_axis` never returns.
    let inverse = Series::of(&omega, &Vector3::zeros(), sigma).translation.try_inverse();
    tangent(&omega, &inverse.map_or(translation, |inverse| inverse * translation), sigma)
}

/// `Ad(S)`: `S exp(x) S^-1 = exp(Ad(S) x)`.
///
/// # Source
/// Strasdat 2012, sec. 2.4.4, in our order of the tangent.
pub fn adjoint(similarity: &Similarity) -> Matrix7 {
    let rotation = *similarity.isometry.rotation.to_rotation_matrix().matrix();
    let translation = similarity.isometry.translation.vector;
    assemble(&rotation, &(skew(&translation) * rotation), &(rotation * similarity.scaling()), &-translation)
}

/// Inverse of the left Jacobian: `log(exp(d) exp(x)) = x + J_l^-1(x) d` to first order in `d`.
/// That of the right Jacobian is `left_jacobian_inverse(-x)`.
///
/// # Source
/// Sola, Deray & Atchuthan 2018, eq. 71-77, for Sim(3): the series `sum ad(x)^n / (n + 1)!`, inverted by blocks.
pub fn left_jacobian_inverse(x: &Tangent7) -> Matrix7 {
    let (omega, upsilon, sigma) = parts(x);
    let series = Series::of(&omega, &upsilon, sigma);
    // Singular only at whole turns, which no logarithm returns.
    let (Some(rotation), Some(translation)) = (series.rotation.try_inverse(), series.translation.try_inverse()) else {
        return Matrix7::identity();
    };
    assemble(&rotation, &(-translation * series.mixed * rotation), &translation, &(-translation * series.scale))
}

/// Rotation, translation and scale of a tangent vector.
fn parts(x: &Tangent7) -> (Vector3<f64>, Vector3<f64>, f64) {
    (Vector3::new(x[0], x[1], x[2]), Vector3::new(x[3], x[4], x[5]), x[6])
}

fn tangent(omega: &Vector3<f64>, upsilon: &Vector3<f64>, sigma: f64) -> Tangent7 {
    Tangent7::from([omega.x, omega.y, omega.z, upsilon.x, upsilon.y, upsilon.z, sigma])
}

/// The blocks that every polynomial in `ad` has: `[rotation 0 0; mixed translation scale; 0 0 1]`.
fn assemble(
    rotation: &Matrix3<f64>,
    mixed: &Matrix3<f64>,
    translation: &Matrix3<f64>,
    scale: &Vector3<f64>,
) -> Matrix7 {
    let mut matrix = Matrix7::zeros();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(rotation);
    matrix.fixed_view_mut::<3, 3>(3, 0).copy_from(mixed);
    matrix.fixed_view_mut::<3, 3>(3, 3).copy_from(translation);
    matrix.fixed_view_mut::<3, 1>(3, 6).copy_from(scale);
    matrix[(6, 6)] = 1.0;
    matrix
}

/// Blocks of the left Jacobian, `sum ad(x)^n / (n + 1)!`; `translation` is also the matrix that [`exp`] needs.
struct Series {
    rotation: Matrix3<f64>,
    mixed: Matrix3<f64>,
    translation: Matrix3<f64>,
    scale: Vector3<f64>,
}

impl Series {
    fn of(omega: &Vector3<f64>, upsilon: &Vector3<f64>, sigma: f64) -> Self {
        let (turn, shift) = (skew(omega), skew(upsilon));
        let grow = turn + Matrix3::identity() * sigma;
        let mut sum = Self {
            rotation: Matrix3::identity(),
            mixed: Matrix3::zeros(),
            translation: Matrix3::identity(),
            scale: upsilon * -0.5,
        };
        let mut term =
            Self { rotation: sum.rotation, mixed: sum.mixed, translation: sum.translation, scale: sum.scale };
        let (size, mut bound) = (omega.norm() + libm::fabs(sigma), 1.0);
        for n in 1..MAX_TERMS {
            let divisor = 1.0 / (n + 1) as f64;
            term.mixed = (shift * term.rotation + grow * term.mixed) * divisor;
            term.rotation = turn * term.rotation * divisor;
            term.translation = grow * term.translation * divisor;
            if n > 1 {
                term.scale = grow * term.scale * divisor;
                sum.scale += term.scale;
            }
            sum.mixed += term.mixed;
            sum.rotation += term.rotation;
            sum.translation += term.translation;
            bound *= size * divisor;
            if bound < NEGLIGIBLE_TERM {
                break;
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix4, Point3};
    use std::vec::Vec;

    /// Tangents at zero, at 1e-9, around everything that could be a branch, near half a turn, and with large scales.
    fn tangents() -> Vec<Tangent7> {
        let mut all = Vec::new();
        for angle in [0.0, 1e-9, 1e-4, 0.3, 1.7, 3.1] {
            for sigma in [0.0, 1e-9, -1e-4, 0.02, -0.7, 2.0] {
                let omega = Vector3::new(1.0, -2.0, 0.5).normalize() * angle;
                all.push(tangent(&omega, &Vector3::new(0.4, -7.0, 2.0), sigma));
            }
        }
        all
    }

    /// `exp` of the 4x4 generator by halving and squaring, which shares nothing with the formula under test.
    fn exp_of_generator(x: &Tangent7) -> Matrix4<f64> {
        let (omega, upsilon, sigma) = parts(x);
        let mut generator = Matrix4::zeros();
        generator.fixed_view_mut::<3, 3>(0, 0).copy_from(&(skew(&omega) + Matrix3::identity() * sigma));
        generator.fixed_view_mut::<3, 1>(0, 3).copy_from(&upsilon);
        let small = generator / 1024.0;
        let mut sum = Matrix4::identity();
        for n in (1..12).rev() {
            sum = Matrix4::identity() + small * sum / f64::from(n);
        }
        (0..10).fold(sum, |power, _| power * power)
    }

    #[test]
    fn exp_is_the_exponential_of_the_generator() {
        for x in tangents() {
            let off = exp(&x).to_homogeneous() - exp_of_generator(&x);
            assert!(off.norm() < 1e-9, "{x}: {off}");
        }
    }

    #[test]
    fn log_undoes_exp() {
        for x in tangents() {
            let back = log(&exp(&x));
            assert!((back - x).norm() < 1e-9, "{x}: {back}");
        }
    }

    #[test]
    fn scales_that_no_map_has_are_held_finite() {
        for sigma in [-1e9, 1e9] {
            let scale = exp(&tangent(&Vector3::zeros(), &Vector3::zeros(), sigma)).scaling();
            assert!(scale > 1e-4 && scale < 1e4, "{scale}");
        }
    }

    #[test]
    fn the_adjoint_carries_increments_across() {
        for (x, d) in tangents().into_iter().zip(tangents().into_iter().rev()) {
            let (s, d) = (exp(&x), d * 0.01);
            let across = exp(&(adjoint(&s) * d)) * s;
            let point = Point3::new(1.0, 2.0, 3.0);
            assert!((across * point - s * exp(&d) * point).norm() < 1e-9, "{x} {d}");
        }
    }

    #[test]
    fn the_inverse_jacobian_agrees_with_differences() {
        for x in tangents() {
            let s = exp(&x);
            let (left, right) = (left_jacobian_inverse(&x), left_jacobian_inverse(&-x));
            for k in 0..7 {
                let mut d = Tangent7::zeros();
                d[k] = 1e-5;
                let by_left = (log(&(exp(&d) * s)) - log(&(exp(&-d) * s))) / 2e-5;
                let by_right = (log(&(s * exp(&d))) - log(&(s * exp(&-d)))) / 2e-5;
                assert!((by_left - left.column(k)).norm() < 1e-5, "left {k} at {x}: {by_left}");
                assert!((by_right - right.column(k)).norm() < 1e-5, "right {k} at {x}: {by_right}");
            }
        }
    }
}
