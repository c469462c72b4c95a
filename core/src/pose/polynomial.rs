//! Real roots of small polynomials.

use heapless::Vec;

/// Highest degree that [`real_roots`] takes; the five-point problem needs 10.
pub const MAX_DEGREE: usize = 10;

/// Halvings or Newton steps until a bracketed root is exact to f64.
const MAX_STEPS: usize = 120;

/// Coefficients below this fraction of the largest are treated as absent at the top of the polynomial.
const NEGLIGIBLE_RATIO: f64 = 1e-14;

/// Value of `c[0] + c[1] x + ...` and of its derivative (Horner).
fn value_and_slope(coefficients: &[f64], x: f64) -> (f64, f64) {
    coefficients.iter().rev().fold((0.0, 0.0), |(value, slope), &c| (value * x + c, slope * x + value))
}

/// The root between `low` and `high`, whose values have opposite signs: Newton kept inside the bracket.
fn bracketed_root(coefficients: &[f64], mut low: f64, mut high: f64) -> f64 {
    let low_is_negative = value_and_slope(coefficients, low).0 < 0.0;
    let mut x = 0.5 * (low + high);
    let mut last_step = high - low;
    for _ in 0..MAX_STEPS {
        let (value, slope) = value_and_slope(coefficients, x);
        if value == 0.0 {
            return x;
        }
        if (value < 0.0) == low_is_negative {
            low = x;
        } else {
            high = x;
        }
        // Far from the root of a high degree Newton crawls: unless it halves its step, the bracket is halved.
        let newton = x - value / slope;
        let is_fast = newton > low && newton < high && (newton - x).abs() < 0.5 * last_step.abs();
        let next = if is_fast { newton } else { 0.5 * (low + high) };
        last_step = next - x;
        if last_step.abs() <= f64::EPSILON * x.abs() {
            return next;
        }
        x = next;
    }
    x
}

/// All simple real roots of `coefficients[0] + coefficients[1] x + ...`, ascending.
///
/// Between neighbouring roots of its derivative a polynomial is monotonic, so the roots of the derivatives,
/// from the linear one upwards, bracket the roots of the next one. Double roots may be missed.
///
/// # Inputs
/// * `coefficients`: lowest degree first, at most [`MAX_DEGREE`]` + 1` of them; more give no roots.
///
/// # Output
/// The roots; none for a constant or for coefficients that are not finite.
///
/// # Cost
/// O(degree^2) bracketed Newton solves; 0.5 KiB of stack.
///
/// # Source
/// Rolle's theorem; Fujiwara's 1916 bound on roots. Own implementation.
pub fn real_roots(coefficients: &[f64]) -> Vec<f64, MAX_DEGREE> {
    let mut roots = Vec::new();
    let largest = coefficients.iter().fold(0.0_f64, |m, c| m.max(c.abs()));
    if !largest.is_finite() || coefficients.iter().any(|c| c.is_nan()) || coefficients.len() > MAX_DEGREE + 1 {
        return roots;
    }
    let Some(degree) = coefficients.iter().rposition(|c| c.abs() > NEGLIGIBLE_RATIO * largest) else { return roots };
    let bound = (0..degree)
        .map(|i| libm::pow((coefficients[i] / coefficients[degree]).abs(), 1.0 / (degree - i) as f64))
        .fold(f64::MIN_POSITIVE, f64::max)
        * 2.0;
    for level in (0..degree).rev() {
        // The derivative of order `level`, whose degree is `degree - level`.
        let mut derivative = [0.0; MAX_DEGREE + 1];
        let n = degree - level + 1;
        for (i, slot) in derivative.iter_mut().enumerate().take(n) {
            let factor = (i + 1..=i + level).fold(1.0, |f, k| f * k as f64);
            *slot = coefficients[i + level] * factor;
        }
        roots = roots_between(&derivative[..n], &roots, bound);
    }
    roots
}

/// Roots of a polynomial that is monotonic between `turning_points`.
fn roots_between(coefficients: &[f64], turning_points: &[f64], bound: f64) -> Vec<f64, MAX_DEGREE> {
    let mut roots = Vec::new();
    let mut low = -bound;
    let mut value_low = value_and_slope(coefficients, low).0;
    for &high in turning_points.iter().chain(core::iter::once(&bound)) {
        let value_high = value_and_slope(coefficients, high).0;
        if (value_low < 0.0) != (value_high < 0.0) {
            // Rolle allows at most as many roots as the degree: there is room for each.
            let _ = roots.push(bracketed_root(coefficients, low, high));
        }
        (low, value_low) = (high, value_high);
    }
    roots
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::vec::Vec as StdVec;

    fn check(expected: &[f64], factor: f64) {
        let mut coefficients = StdVec::from([factor]);
        for root in expected {
            let mut product = StdVec::from([0.0]);
            product.extend_from_slice(&coefficients);
            for (i, c) in coefficients.iter().enumerate() {
                product[i] -= root * c;
            }
            coefficients = product;
        }
        let found = real_roots(&coefficients);
        assert_eq!(found.len(), expected.len(), "{found:?} for {expected:?}");
        for (f, e) in found.iter().zip(expected) {
            assert!((f - e).abs() < 1e-6 * (1.0 + e.abs()), "{found:?} for {expected:?}");
        }
    }

    #[test]
    fn roots_come_back_in_order() {
        check(&[], 3.0);
        check(&[4.0], -2.0);
        check(&[-1.5, 0.0, 1e-3], 1.0);
        check(&[-30.0, -2.0, -1.0, 0.5, 7.0], 1e-4);
        check(&[-5.0, -4.0, -3.0, -2.0, -1.0, 1.0, 2.0, 3.0, 4.0, 5.0], 2.0);
    }

    #[test]
    fn without_real_roots_or_with_nan_there_are_none() {
        assert!(real_roots(&[1.0, 0.0, 1.0]).is_empty());
        assert!(real_roots(&[f64::NAN, 1.0]).is_empty());
        assert!(real_roots(&[f64::INFINITY, 1.0]).is_empty());
        assert!(real_roots(&[0.0; 11]).is_empty());
        assert!(real_roots(&[1.0; 12]).is_empty());
    }
}
