//! How a lens bends the rays of an ideal pinhole camera, on the plane z = 1.

use super::Pinhole;
use core::fmt;
use nalgebra::{Matrix2, Vector2};

/// A lens model with its coefficients, in the order in which OpenCV writes them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lens {
    /// No distortion.
    Pinhole,
    /// Brown & Conrady: `[k1, k2, p1, p2, k3]`, radial and tangential; k3 may be zero.
    RadialTangential([f64; 5]),
    /// Kannala & Brandt, for fisheyes: `[k1, k2, k3, k4]` of the angle's odd powers.
    KannalaBrandt([f64; 4]),
}

/// Newton steps of an inversion at most; four or five are enough within the image.
const MAX_STEPS: usize = 50;
/// A step below this is rounding: 1e-11 px at any focal length below 1000 px.
const NEGLIGIBLE_STEP_Z1: f64 = 1e-14;
/// Largest mismatch of an inversion that counts as found: 1e-10 px at the same focal length.
const MAX_MISMATCH_Z1: f64 = 1e-13;
/// Radius below which the direction of a ray no longer matters to a fisheye.
const TINY_RADIUS: f64 = 1e-8;

impl Lens {
    /// Where the lens shows the ray that an ideal camera would show at `ideal_z1`.
    ///
    /// # Source
    /// Brown 1971, "Close-range camera calibration"; Kannala & Brandt 2006, eq. 6 with the first five terms, in
    /// OpenCV's normalisation (the angle's own coefficient is 1).
    pub fn distort(&self, ideal_z1: &Vector2<f64>) -> Vector2<f64> {
        self.distort_with_derivative(ideal_z1).0
    }

    /// As [`distort`](Self::distort), with the derivative by `ideal_z1`.
    ///
    /// # Source
    /// As there; own derivation of the derivative.
    pub fn distort_with_derivative(&self, ideal_z1: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        match self {
            Self::Pinhole => (*ideal_z1, Matrix2::identity()),
            Self::RadialTangential(coefficients) => radial_tangential(coefficients, ideal_z1),
            Self::KannalaBrandt(coefficients) => kannala_brandt(coefficients, ideal_z1),
        }
    }

    /// The ray that the lens shows at `seen_z1`; `None` where the model shows nothing that a plane z = 1 holds.
    ///
    /// # Cost
    /// A few Newton steps.
    ///
    /// # Source
    /// Newton's method on [`distort`](Self::distort), started on the axis side so that it cannot jump over a fold.
    pub fn undistort(&self, seen_z1: &Vector2<f64>) -> Option<Vector2<f64>> {
        if *self == Self::Pinhole {
            return Some(*seen_z1);
        }
        let mut ideal = Vector2::zeros();
        for _ in 0..MAX_STEPS {
            let (found, derivative) = self.distort_with_derivative(&ideal);
            let step = derivative.try_inverse()? * (seen_z1 - found);
            // A long step from far outside would land beyond the fold; a shorter one goes the same way.
            let longest = 0.5 * (1.0 + ideal.norm());
            let length = step.norm();
            ideal += if length > longest { step * (longest / length) } else { step };
            if length.is_nan() {
                return None;
            }
            if length <= NEGLIGIBLE_STEP_Z1 * (1.0 + ideal.norm()) {
                break;
            }
        }
        let (found, derivative) = self.distort_with_derivative(&ideal);
        let is_found = (found - seen_z1).norm() <= MAX_MISMATCH_Z1 * (1.0 + seen_z1.norm());
        (is_found && derivative.determinant() > 0.0).then_some(ideal)
    }

    /// Whether the model maps the whole image of an ideal camera one to one.
    ///
    /// # Errors
    /// [`LensFolds`] names a pixel where it does not.
    ///
    /// # Source
    /// A smooth map keeps its orientation where its Jacobian determinant is positive (inverse function theorem);
    /// own choice of where to look.
    pub fn check_within(&self, ideal: &Pinhole) -> Result<(), LensFolds> {
        let along = |k: u32, size: u32| f64::from(k) / f64::from(CHECKS_PER_SIDE) * f64::from(size);
        for (row, column) in (0..=CHECKS_PER_SIDE).flat_map(|r| (0..=CHECKS_PER_SIDE).map(move |c| (r, c))) {
            let pixel = Vector2::new(along(column, ideal.width), along(row, ideal.height));
            let (seen, derivative) = self.distort_with_derivative(&ideal.unproject_z1(&pixel));
            // NaN is no order.
            let keeps_order = derivative.determinant() > 0.0 && derivative.trace() > 0.0;
            if !keeps_order || !seen.iter().all(|c| c.is_finite()) {
                return Err(LensFolds { pixel: [pixel.x as i32, pixel.y as i32] });
            }
        }
        Ok(())
    }
}

/// Places along each side of an image where [`Lens::check_within`] looks.
const CHECKS_PER_SIDE: u32 = 64;

/// The lens model is not monotonic: it shows two rays at one place.
///
/// The coefficients belong to another camera or image size, stand in another order, or were fitted to a smaller part
/// of the image: calibrate again, with marks up to the corners.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LensFolds {
    /// An ideal pixel where it happens, px.
    pub pixel: [i32; 2],
}

impl fmt::Display for LensFolds {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [x, y] = self.pixel;
        write!(f, "the lens model folds back on itself at pixel ({x}, {y})")
    }
}

impl core::error::Error for LensFolds {}

fn radial_tangential([k1, k2, p1, p2, k3]: &[f64; 5], p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let (x, y, r2) = (p.x, p.y, p.norm_squared());
    let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
    // By r^2; the derivative of r^2 is 2 p.
    let slope = k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3);
    let seen = Vector2::new(
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
    );
    let mixed = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
    let derivative = Matrix2::new(
        radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        mixed,
        mixed,
        radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    );
    (seen, derivative)
}

fn kannala_brandt([k1, k2, k3, k4]: &[f64; 4], p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
    let r = p.norm();
    if r < TINY_RADIUS {
        return (*p, Matrix2::identity());
    }
    let theta = libm::atan(r);
    let t2 = theta * theta;
    let seen_theta = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
    let slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
    // By r: the angle grows by 1 / (1 + r^2).
    let by_radius = slope / (1.0 + r * r);
    let along = p / r;
    let scale = seen_theta / r;
    (p * scale, Matrix2::identity() * scale + along * along.transpose() * (by_radius - scale))
}

#[cfg(test)]
mod tests;
