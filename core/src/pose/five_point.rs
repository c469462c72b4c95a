//! The relative pose of two calibrated views from five matches.

use super::Match;
use super::polynomial::{MAX_DEGREE, real_roots};
use heapless::Vec;
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// Matches of a minimal sample.
pub const SAMPLE_SIZE: usize = 5;

/// Monomials up to degree 3 in x, y, z, as exponents, in the order of Nister's elimination: the ten that are
/// eliminated, then [x, y, 1] times powers of z.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// Where the product of two monomials stands; `NOWHERE` above degree 3.
const PRODUCT: [[u8; 20]; 20] = product_table();
const NOWHERE: u8 = u8::MAX;
/// The monomials of degree one and zero: x, y, z, 1.
const LINEAR: [usize; 4] = [12, 15, 18, 19];
/// A pivot below this means that the five matches do not determine the pose.
const MIN_PIVOT: f64 = 1e-14;

const fn product_table() -> [[u8; 20]; 20] {
    let mut table = [[NOWHERE; 20]; 20];
    let mut i = 0;
    while i < 20 {
        let mut j = 0;
        while j < 20 {
            let mut k = 0;
            while k < 20 {
                let (a, b, c) = (MONOMIALS[i], MONOMIALS[j], MONOMIALS[k]);
                if a[0] + b[0] == c[0] && a[1] + b[1] == c[1] && a[2] + b[2] == c[2] {
                    table[i][j] = k as u8;
                }
                k += 1;
            }
            j += 1;
        }
        i += 1;
    }
    table
}

type Cubic = SVector<f64, 20>;

/// Product of a polynomial with one of lower degree; terms above degree 3 do not occur by construction.
fn multiply(a: &Cubic, b: &Cubic, b_terms: &[usize]) -> Cubic {
    let mut product = Cubic::zeros();
    for i in 0..20 {
        if a[i] == 0.0 {
            continue;
        }
        for &j in b_terms {
            let k = PRODUCT[i][j];
            if k != NOWHERE {
                product[k as usize] += a[i] * b[j];
            }
        }
    }
    product
}

/// Orthonormal basis of the essential matrices that five epipolar constraints leave open.
fn null_space(sample: &[Match; SAMPLE_SIZE]) -> Option<[Matrix3<f64>; 4]> {
    let mut basis = [SVector::<f64, 9>::zeros(); 9];
    for (i, m) in sample.iter().enumerate() {
        let (a, b) = (m.first_z1, m.second_z1);
        let row = SVector::<f64, 9>::from([b.x * a.x, b.x * a.y, b.x, b.y * a.x, b.y * a.y, b.y, a.x, a.y, 1.0]);
        let rest = orthogonalize(&orthogonalize(&row, &basis[..i]), &basis[..i]);
        let norm = rest.norm();
        if norm.is_nan() || norm < MIN_PIVOT * row.norm() {
            return None;
        }
        basis[i] = rest / norm;
    }
    for i in SAMPLE_SIZE..9 {
        let best = (0..9)
            .map(|k| orthogonalize(&unit9(k), &basis[..i]))
            .max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
        basis[i] = orthogonalize(&best, &basis[..i]).normalize();
    }
    let as_matrix = |v: &SVector<f64, 9>| Matrix3::from_row_slice(v.as_slice());
    Some([as_matrix(&basis[5]), as_matrix(&basis[6]), as_matrix(&basis[7]), as_matrix(&basis[8])])
}

fn unit9(k: usize) -> SVector<f64, 9> {
    SVector::from_fn(|i, _| if i == k { 1.0 } else { 0.0 })
}

fn orthogonalize(v: &SVector<f64, 9>, basis: &[SVector<f64, 9>]) -> SVector<f64, 9> {
    basis.iter().fold(*v, |rest, b| rest - b * b.dot(&rest))
}

/// The ten cubic constraints `det E = 0` and `2 E E^T E - trace(E E^T) E = 0`.
#[expect(clippy::needless_range_loop, reason = "the indices are those of the formula")]
fn constraints(basis: &[Matrix3<f64>; 4]) -> SMatrix<f64, 10, 20> {
    const ALL: [usize; 20] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19];
    let entry = |r: usize, c: usize| {
        let mut linear = Cubic::zeros();
        for (slot, matrix) in LINEAR.iter().zip(basis) {
            linear[*slot] = matrix[(r, c)];
        }
        linear
    };
    let e: [[Cubic; 3]; 3] = core::array::from_fn(|r| core::array::from_fn(|c| entry(r, c)));
    let times = |a: &Cubic, b: &Cubic| multiply(a, b, &LINEAR);
    let mut rows = SMatrix::<f64, 10, 20>::zeros();
    let minor = |c0: usize, c1: usize| times(&e[1][c0], &e[2][c1]) - times(&e[1][c1], &e[2][c0]);
    let determinant = times(&minor(1, 2), &e[0][0]) + times(&minor(2, 0), &e[0][1]) + times(&minor(0, 1), &e[0][2]);
    rows.set_row(0, &determinant.transpose());

    let gram = |i: usize, j: usize| (0..3).fold(Cubic::zeros(), |sum, k| sum + times(&e[i][k], &e[j][k]));
    let mut eet = [[Cubic::zeros(); 3]; 3];
    for i in 0..3 {
        for j in i..3 {
            eet[i][j] = gram(i, j);
            eet[j][i] = eet[i][j];
        }
    }
    let half_trace = (eet[0][0] + eet[1][1] + eet[2][2]) * 0.5;
    for (i, row) in eet.iter_mut().enumerate() {
        row[i] -= half_trace;
    }
    for i in 0..3 {
        for j in 0..3 {
            let sum = (0..3).fold(Cubic::zeros(), |sum, k| sum + multiply(&e[k][j], &eet[i][k], &ALL));
            rows.set_row(1 + 3 * i + j, &sum.transpose());
        }
    }
    rows
}

/// Gauss-Jordan elimination of the first ten columns; `None` when the sample is degenerate.
fn eliminate(mut rows: SMatrix<f64, 10, 20>) -> Option<SMatrix<f64, 10, 20>> {
    for column in 0..10 {
        let pivot_row = (column..10).max_by(|&a, &b| rows[(a, column)].abs().total_cmp(&rows[(b, column)].abs()))?;
        let pivot = rows[(pivot_row, column)];
        if pivot.is_nan() || pivot.abs() < MIN_PIVOT {
            return None;
        }
        rows.swap_rows(column, pivot_row);
        for k in column..20 {
            rows[(column, k)] /= pivot;
        }
        for r in 0..10 {
            let factor = rows[(r, column)];
            if r != column && factor != 0.0 {
                for k in column..20 {
                    rows[(r, k)] -= factor * rows[(column, k)];
                }
            }
        }
    }
    Some(rows)
}

/// Coefficients in z, lowest first, of one row `upper - z * lower` as [x, y, 1].
fn z_row(rows: &SMatrix<f64, 10, 20>, upper: usize, lower: usize) -> [[f64; 5]; 3] {
    let part = |from: usize, n: usize| {
        let mut out = [0.0; 5];
        for power in 0..n {
            out[power] += rows[(upper, from + n - 1 - power)];
            out[power + 1] -= rows[(lower, from + n - 1 - power)];
        }
        out
    };
    [part(10, 3), part(13, 3), part(16, 4)]
}

fn convolve<const A: usize, const B: usize>(a: &[f64; A], b: &[f64; B], out: &mut [f64; MAX_DEGREE + 1], sign: f64) {
    for (i, x) in a.iter().enumerate() {
        for (j, y) in b.iter().enumerate() {
            if let Some(slot) = out.get_mut(i + j) {
                *slot += sign * x * y;
            }
        }
    }
}

/// Determinant of the 3x3 matrix of polynomials.
fn determinant(b: &[[[f64; 5]; 3]; 3]) -> [f64; MAX_DEGREE + 1] {
    let mut det = [0.0; MAX_DEGREE + 1];
    for (i, j, k, sign) in
        [(0, 1, 2, 1.0), (1, 2, 0, 1.0), (2, 0, 1, 1.0), (0, 2, 1, -1.0), (1, 0, 2, -1.0), (2, 1, 0, -1.0)]
    {
        let mut pair = [0.0; MAX_DEGREE + 1];
        convolve(&b[0][i], &b[1][j], &mut pair, sign);
        convolve(&pair, &b[2][k], &mut det, 1.0);
    }
    det
}

/// All essential matrices that satisfy five matches: `second^T E first = 0`.
///
/// # Inputs
/// * `sample`: five matches on the plane z = 1.
///
/// # Output
/// Up to ten essential matrices of unit Frobenius norm; none when the sample is degenerate.
///
/// # Cost
/// About 20 microseconds, 8 KiB of stack.
///
/// # Source
/// Nister 2004, "An efficient solution to the five-point relative pose problem", sections 3.1-3.2. Own
/// implementation: polynomials are multiplied by table instead of expanded by hand, and roots are bracketed
/// by derivatives instead of Sturm sequences.
pub fn five_point(sample: &[Match; SAMPLE_SIZE]) -> Vec<Matrix3<f64>, MAX_DEGREE> {
    let mut found = Vec::new();
    let Some(basis) = null_space(sample) else { return found };
    let Some(rows) = eliminate(constraints(&basis)) else { return found };
    let b = [z_row(&rows, 4, 5), z_row(&rows, 6, 7), z_row(&rows, 8, 9)];
    for z in real_roots(&determinant(&b)) {
        let at = |r: usize, c: usize| b[r][c].iter().rev().fold(0.0, |sum, k| sum * z + k);
        let row = |r: usize| Vector3::new(at(r, 0), at(r, 1), at(r, 2));
        let candidates = [row(0).cross(&row(1)), row(1).cross(&row(2)), row(2).cross(&row(0))];
        let Some(xy1) = candidates.into_iter().max_by(|p, q| p.z.abs().total_cmp(&q.z.abs())) else { continue };
        let essential = basis[0] * (xy1.x / xy1.z) + basis[1] * (xy1.y / xy1.z) + basis[2] * z + basis[3];
        let norm = essential.norm();
        if norm.is_finite() && norm > 0.0 {
            let _ = found.push(essential / norm);
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conventions::Rigid;
    use crate::math::{Rng, se3, se3::skew};
    use nalgebra::Vector6;

    fn sample_of(second_from_first: &Rigid, rng: &mut Rng) -> [Match; 5] {
        core::array::from_fn(|_| {
            let z = 4.0 + 30.0 * rng.unit_f64();
            let p = Vector3::new((rng.unit_f64() - 0.5) * z, (rng.unit_f64() - 0.5) * z, z);
            let q = second_from_first * nalgebra::Point3::from(p);
            Match { first_z1: (p / p.z).xy(), second_z1: (q.coords / q.z).xy() }
        })
    }

    #[test]
    fn one_of_the_solutions_is_the_true_motion() {
        let mut rng = Rng::new(5, 0, 0);
        // Near pure translation two solutions nearly coincide, and f64 separates fewer of them.
        let cases = [
            ([0.0, 0.02, 0.0, 0.1, 0.0, 1.0], 95),
            ([0.01, -0.2, 0.03, 0.0, -0.02, 1.5], 95),
            ([0.3, 0.1, -0.2, 2.0, 1.0, 0.1], 95),
            ([0.0, 0.003, 0.0, 0.0, 0.0, 1.0], 75),
        ];
        for (tangent, at_least) in cases {
            let second_from_first = se3::exp(&Vector6::from(tangent));
            let truth =
                skew(&second_from_first.translation.vector) * second_from_first.rotation.to_rotation_matrix().matrix();
            let truth = truth / truth.norm();
            let error_of_best = |sample: &[Match; 5]| {
                let errors = five_point(sample).into_iter().map(|e| (e - truth).norm().min((e + truth).norm()));
                errors.fold(f64::INFINITY, f64::min)
            };
            let n_solved = (0..100).filter(|_| error_of_best(&sample_of(&second_from_first, &mut rng)) < 0.01).count();
            assert!(n_solved >= at_least, "{n_solved} of 100 for {tangent:?}");
        }
    }

    #[test]
    fn a_repeated_match_or_nan_gives_nothing() {
        let mut rng = Rng::new(6, 0, 0);
        let mut sample = sample_of(&se3::exp(&Vector6::new(0.0, 0.1, 0.0, 0.0, 0.0, 1.0)), &mut rng);
        sample[1] = sample[0];
        assert!(five_point(&sample).is_empty());
        sample[1].first_z1.x = f64::NAN;
        assert!(five_point(&sample).is_empty());
    }
}
