//! The pose equations that remain when the depths are eliminated.

use crate::keyframe::WINDOW;
use nalgebra::{Matrix6, Vector6};

/// Unknowns of a window's poses.
const SIZE: usize = 6 * WINDOW;

/// Dense normal equations of the free keyframes, in memory that is reused; about 18 KiB.
#[derive(Clone, Debug)]
pub struct ReducedSystem {
    matrix: [[f64; SIZE]; SIZE],
    right: [f64; SIZE],
}

impl Default for ReducedSystem {
    fn default() -> Self {
        Self::new()
    }
}

impl ReducedSystem {
    /// All zero.
    pub const fn new() -> Self {
        Self { matrix: [[0.0; SIZE]; SIZE], right: [0.0; SIZE] }
    }

    /// All zero again.
    pub fn clear(&mut self) {
        self.matrix = [[0.0; SIZE]; SIZE];
        self.right = [0.0; SIZE];
    }

    /// Adds a block of the lower triangle: `row >= column`, counted in keyframes.
    pub(super) fn add_block(&mut self, row: usize, column: usize, block: &Matrix6<f64>) {
        for (i, target) in self.matrix.iter_mut().skip(6 * row).take(6).enumerate() {
            for (j, value) in target.iter_mut().skip(6 * column).take(6).enumerate() {
                *value += block[(i, j)];
            }
        }
    }

    /// Adds to the gradient.
    pub(super) fn add_gradient(&mut self, row: usize, gradient: &Vector6<f64>) {
        for (value, g) in self.right.iter_mut().skip(6 * row).take(6).zip(gradient.iter()) {
            *value += g;
        }
    }

    /// Solves for the step that lowers the cost, with the diagonal enlarged by `damping`; destroys the system.
    /// `None` when it is not positive definite.
    pub(super) fn solve(&mut self, n_keyframes: usize, damping: f64) -> Option<[Vector6<f64>; WINDOW]> {
        let n = 6 * n_keyframes;
        for i in 0..n {
            self.matrix[i][i] *= 1.0 + damping;
        }
        // Cholesky, lower triangle in place (Golub & Van Loan 2013, alg. 4.2.1).
        for j in 0..n {
            for i in j..n {
                let dot: f64 = (0..j).map(|k| self.matrix[i][k] * self.matrix[j][k]).sum();
                let rest = self.matrix[i][j] - dot;
                if i == j {
                    if rest.is_nan() || rest <= 0.0 {
                        return None;
                    }
                    self.matrix[j][j] = libm::sqrt(rest);
                } else {
                    self.matrix[i][j] = rest / self.matrix[j][j];
                }
            }
        }
        let mut x = [0.0; SIZE];
        for i in 0..n {
            let dot: f64 = (0..i).map(|k| self.matrix[i][k] * x[k]).sum();
            x[i] = (-self.right[i] - dot) / self.matrix[i][i];
        }
        for i in (0..n).rev() {
            let dot: f64 = (i + 1..n).map(|k| self.matrix[k][i] * x[k]).sum();
            x[i] = (x[i] - dot) / self.matrix[i][i];
        }
        Some(core::array::from_fn(|k| Vector6::from_fn(|i, _| x[6 * k + i])))
    }
}
