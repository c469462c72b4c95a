//! Kernels on 7x7 blocks, column by column so that the compiler vectorises them.

use crate::math::sim3::{Matrix7, Tangent7};

const N: usize = 7;

/// Lower Cholesky factor in place; false when the block is not positive definite. The upper triangle is left as it is.
pub(super) fn cholesky(matrix: &mut Matrix7) -> bool {
    let a = &mut matrix.data.0;
    for j in 0..N {
        let mut column = a[j];
        for done in a.iter().take(j) {
            let factor = done[j];
            for (value, d) in column.iter_mut().zip(done) {
                *value -= d * factor;
            }
        }
        if column[j].is_nan() || column[j] <= 0.0 {
            return false;
        }
        let inverse = 1.0 / libm::sqrt(column[j]);
        a[j] = column.map(|value| value * inverse);
    }
    true
}

/// `b L^-T`.
pub(super) fn right_solve(b: &Matrix7, lower: &Matrix7) -> Matrix7 {
    let mut x = *b;
    for c in 0..N {
        let mut column = x.data.0[c];
        for (solved, l) in x.data.0.iter().zip(&lower.data.0).take(c) {
            for (value, done) in column.iter_mut().zip(solved) {
                *value -= done * l[c];
            }
        }
        let inverse = 1.0 / lower[(c, c)];
        x.data.0[c] = column.map(|value| value * inverse);
    }
    x
}

/// `L^-1 b`.
pub(super) fn forward_solve(lower: &Matrix7, b: &Tangent7) -> Tangent7 {
    let mut x = *b;
    for i in 0..N {
        let dot: f64 = (0..i).map(|k| lower[(i, k)] * x[k]).sum();
        x[i] = (x[i] - dot) / lower[(i, i)];
    }
    x
}

/// `L^-T b`.
pub(super) fn backward_solve(lower: &Matrix7, b: &Tangent7) -> Tangent7 {
    let mut x = *b;
    for i in (0..N).rev() {
        let dot: f64 = (i + 1..N).map(|k| lower[(k, i)] * x[k]).sum();
        x[i] = (x[i] - dot) / lower[(i, i)];
    }
    x
}

/// `target -= a b^T`.
pub(super) fn subtract_product(target: &mut Matrix7, a: &Matrix7, b: &Matrix7) {
    let (a, b) = (&a.data.0, &b.data.0);
    for (j, column) in target.data.0.iter_mut().enumerate() {
        let mut sum = *column;
        for k in 0..N {
            let factor = b[k][j];
            for (value, x) in sum.iter_mut().zip(&a[k]) {
                *value -= x * factor;
            }
        }
        *column = sum;
    }
}

/// `a b`.
pub(super) fn product(a: &Matrix7, b: &Matrix7) -> Matrix7 {
    let mut result = Matrix7::zeros();
    for (column, factors) in result.data.0.iter_mut().zip(&b.data.0) {
        let mut sum = [0.0; N];
        for (x, factor) in a.data.0.iter().zip(factors) {
            for (value, x) in sum.iter_mut().zip(x) {
                *value += x * factor;
            }
        }
        *column = sum;
    }
    result
}
