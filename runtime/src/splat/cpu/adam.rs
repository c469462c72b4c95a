//! Adam (Kingma & Ba 2015, algorithm 1).

use super::lane::Lane;
use crate::splat::kernel_constants::{
    ADAM_BETA1 as BETA1, ADAM_BETA2 as BETA2, ADAM_EPSILON as EPSILON, ADAM_LOG2_BETA1 as LOG2_BETA1,
    ADAM_LOG2_BETA2 as LOG2_BETA2, MAX_GRADIENT,
};

/// Corrections of the two running means for their start at zero.
#[derive(Clone, Copy)]
pub struct BiasCorrection<L> {
    /// `1 / (1 - beta1^t)`.
    pub first: L,
    /// `1 / sqrt(1 - beta2^t)`.
    pub second: L,
}

impl<L: Lane> BiasCorrection<L> {
    /// Corrections at step `t`, counted from 1.
    #[inline(always)]
    pub fn at(step: L) -> Self {
        let one = step.constant(1.0);
        let beta1_power = (step * step.constant(LOG2_BETA1)).exp2();
        let beta2_power = (step * step.constant(LOG2_BETA2)).exp2();
        Self { first: one / (one - beta1_power), second: one / (one - beta2_power).sqrt() }
    }
}

/// One step of one number; returns the new `(value, first moment, second moment)`.
#[inline(always)]
pub fn adam<L: Lane>(value: L, first: L, second: L, gradient: L, rate: L, correction: &BiasCorrection<L>) -> [L; 3] {
    let usable = gradient.abs().lt(gradient.constant(f64::from(MAX_GRADIENT)));
    let gradient = gradient.zero().replace(usable, gradient);
    let first = first.mul_add(first.constant(BETA1), gradient * first.constant(1.0 - BETA1));
    let second = second.mul_add(second.constant(BETA2), gradient * gradient * second.constant(1.0 - BETA2));
    let denominator = second.sqrt().mul_add(correction.second, second.constant(EPSILON));
    [value - rate * correction.first * first / denominator, first, second]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(gradients: &[f64]) -> f64 {
        let (mut value, mut first, mut second) = (1.0, 0.0, 0.0);
        for (t, &gradient) in gradients.iter().enumerate() {
            let correction = BiasCorrection::at((t + 1) as f64);
            [value, first, second] = adam(value, first, second, gradient, 0.1, &correction);
        }
        value
    }

    #[test]
    fn steps_agree_with_the_algorithm_by_hand() {
        // Step 1 moves by the rate whatever the gradient's size; step 2 by hand from the running means.
        assert!((walk(&[3.0]) - 0.9).abs() < 1e-12);
        assert!((walk(&[-1e-9]) - 1.1).abs() < 1e-6);
        let first = (0.9 * 0.3 - 0.1) / (1.0 - 0.81);
        let second = (0.999 * 0.009 + 0.001) / (1.0 - 0.998_001);
        let expected: f64 = 0.9 - 0.1 * first / f64::sqrt(second);
        assert!((walk(&[3.0, -1.0]) - expected).abs() < 1e-9);
    }

    #[test]
    fn a_gradient_that_is_no_number_changes_nothing() {
        for bad in [f64::NAN, f64::INFINITY, -f64::INFINITY] {
            assert_eq!(walk(&[bad]), 1.0);
        }
    }

    #[test]
    fn a_parabola_is_descended() {
        let (mut value, mut first, mut second) = (5.0, 0.0, 0.0);
        for t in 0..2000 {
            [value, first, second] =
                adam(value, first, second, 2.0 * value, 0.02, &BiasCorrection::at(f64::from(t + 1)));
        }
        assert!(value.abs() < 0.01, "{value}");
    }
}
