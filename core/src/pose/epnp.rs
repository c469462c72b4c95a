//! The pose of a camera from many points at once, without a start.

use crate::conventions::Rigid;
use nalgebra::{
    Matrix3, Matrix4, Matrix6, Rotation3, SMatrix, SVector, Translation3, UnitQuaternion, Vector2, Vector3,
};

/// Fewest points that fix the pose.
pub const MIN_POINTS: usize = 5;
/// Numbers of the four control points.
const N: usize = 12;
/// Gauss-Newton steps on the weights of the null vectors.
const WEIGHT_STEPS: usize = 8;
/// Spread along an axis, relative to the widest, below which the points lie in a plane.
const FLAT: f64 = 1e-6;
/// Pairs of control points, whose distances are known.
const PAIRS: [(usize, usize); 6] = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)];

/// The pose from which points look the way they do, in the least-squares sense of an algebraic error.
///
/// Every point is a fixed mean of four control points. Their places in the camera's axes are a combination of the
/// weakest eigenvectors of a 12 x 12 matrix, with weights that keep the distances between them.
///
/// # Inputs
/// * `points`: places in the reference axes (m) and where the camera sees them on its plane z = 1; no outliers. Read
///   three times.
///
/// # Output
/// `camera_from_reference`; `None` for fewer than five points, for points in a plane or on a line (use [`p3p`] and
/// refine), and where no combination puts them in front of the camera.
///
/// # Cost
/// O(n) sums of 12 x 12 entries, and one eigenvalue problem of that size.
///
/// # Source
/// Lepetit, Moreno-Noguer & Fua 2009, "EPnP: an accurate O(n) solution to the PnP problem", sec. 3. Own implementation.
///
/// [`p3p`]: super::p3p()
pub fn epnp(points: impl Iterator<Item = (Vector3<f64>, Vector2<f64>)> + Clone) -> Option<Rigid> {
    let n = points.clone().count();
    if n < MIN_POINTS {
        return None;
    }
    let control = control_points(points.clone().map(|(p, _)| p), n)?;
    let mut to_weights = Matrix4::from_element(1.0);
    for (k, c) in control.iter().enumerate() {
        to_weights.fixed_view_mut::<3, 1>(0, k).copy_from(c);
    }
    let to_weights = to_weights.try_inverse()?;
    let weights_of = |p: &Vector3<f64>| to_weights * p.push(1.0);
    let mut normal = SMatrix::<f64, N, N>::zeros();
    for (p, seen_z1) in points.clone() {
        let alpha = weights_of(&p);
        let (mut row_x, mut row_y) = (SVector::<f64, N>::zeros(), SVector::<f64, N>::zeros());
        for k in 0..4 {
            (row_x[3 * k], row_x[3 * k + 2]) = (alpha[k], -alpha[k] * seen_z1.x);
            (row_y[3 * k + 1], row_y[3 * k + 2]) = (alpha[k], -alpha[k] * seen_z1.y);
        }
        normal += row_x * row_x.transpose() + row_y * row_y.transpose();
    }
    let vectors = weakest_vectors(&normal);
    let mut best: Option<(f64, Rigid)> = None;
    for n_vectors in 1..=3 {
        let Some(weights) = vector_weights(&vectors, &control, n_vectors) else { continue };
        let in_camera = combine(&vectors, &weights);
        let Some(pose) = absolute_orientation(&control, &in_camera, points.clone(), weights_of) else { continue };
        let error: f64 = points.clone().map(|(p, seen_z1)| squared_error(&pose, &p, &seen_z1)).sum();
        if error.is_finite() && best.as_ref().is_none_or(|(least, _)| error < *least) {
            best = Some((error, pose));
        }
    }
    best.map(|(_, pose)| pose)
}

/// The centroid and one point along each principal axis.
fn control_points(points: impl Iterator<Item = Vector3<f64>> + Clone, n: usize) -> Option<[Vector3<f64>; 4]> {
    let centroid = points.clone().sum::<Vector3<f64>>() / n as f64;
    let spread = points.map(|p| (p - centroid) * (p - centroid).transpose()).sum::<Matrix3<f64>>() / n as f64;
    let axes = spread.symmetric_eigen();
    if axes.eigenvalues.min() <= FLAT * FLAT * axes.eigenvalues.max() {
        return None;
    }
    let along = |k: usize| centroid + axes.eigenvectors.column(k) * libm::sqrt(axes.eigenvalues[k]);
    Some([centroid, along(0), along(1), along(2)])
}

/// Eigenvectors of the three smallest eigenvalues, smallest first, as control points.
fn weakest_vectors(normal: &SMatrix<f64, N, N>) -> [[Vector3<f64>; 4]; 3] {
    let eigen = normal.symmetric_eigen();
    let mut order: [usize; N] = core::array::from_fn(|k| k);
    order.sort_unstable_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]).then(a.cmp(&b)));
    core::array::from_fn(|rank| {
        let vector = eigen.eigenvectors.column(order[rank]);
        core::array::from_fn(|k| Vector3::new(vector[3 * k], vector[3 * k + 1], vector[3 * k + 2]))
    })
}

fn combine(vectors: &[[Vector3<f64>; 4]; 3], weights: &Vector3<f64>) -> [Vector3<f64>; 4] {
    core::array::from_fn(|k| vectors.iter().zip(weights.iter()).map(|(v, w)| v[k] * *w).sum())
}

/// Weights of the first vectors that keep the distances between control points: a linear start in their products,
/// then Gauss-Newton.
fn vector_weights(
    vectors: &[[Vector3<f64>; 4]; 3],
    control: &[Vector3<f64>; 4],
    n_vectors: usize,
) -> Option<Vector3<f64>> {
    let known = SVector::<f64, 6>::from_fn(|pair, _| (control[PAIRS[pair].0] - control[PAIRS[pair].1]).norm_squared());
    let apart = |pair: usize, v: usize| vectors[v][PAIRS[pair].0] - vectors[v][PAIRS[pair].1];
    // Products of two weights in the order 11, 12, 22, 13, 23, 33; unused ones are held at zero.
    const PRODUCTS: [(usize, usize); 6] = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)];
    let mut products = Matrix6::zeros();
    for pair in 0..6 {
        for (column, &(a, b)) in PRODUCTS.iter().enumerate().filter(|(_, p)| p.0.max(p.1) < n_vectors) {
            let factor = if a == b { 1.0 } else { 2.0 };
            products[(pair, column)] = factor * apart(pair, a).dot(&apart(pair, b));
        }
    }
    let mut normal = products.tr_mul(&products);
    for (column, _) in PRODUCTS.iter().enumerate().filter(|(_, p)| p.0.max(p.1) >= n_vectors) {
        normal[(column, column)] = 1.0;
    }
    let solved = normal.cholesky()?.solve(&products.tr_mul(&known));
    let first = libm::sqrt(solved[0].abs());
    let with_sign = |square: f64, with_first: f64| libm::copysign(libm::sqrt(square.abs()), with_first);
    let mut weights = Vector3::new(first, with_sign(solved[2], solved[1]), with_sign(solved[5], solved[3]));
    for _ in 0..WEIGHT_STEPS {
        let (mut hessian, mut gradient) = (Matrix3::identity() * f64::EPSILON, Vector3::zeros());
        for pair in 0..6 {
            let now: Vector3<f64> = (0..n_vectors).map(|v| apart(pair, v) * weights[v]).sum();
            let slope = Vector3::from_fn(|v, _| if v < n_vectors { 2.0 * now.dot(&apart(pair, v)) } else { 0.0 });
            hessian += slope * slope.transpose();
            gradient += slope * (now.norm_squared() - known[pair]);
        }
        for v in n_vectors..3 {
            hessian[(v, v)] = 1.0;
        }
        weights -= hessian.cholesky()?.solve(&gradient);
    }
    weights.iter().all(|w| w.is_finite()).then_some(weights)
}

/// The motion between two sets of control points that puts the points in front of the camera.
fn absolute_orientation(
    control: &[Vector3<f64>; 4],
    in_camera: &[Vector3<f64>; 4],
    points: impl Iterator<Item = (Vector3<f64>, Vector2<f64>)>,
    weights_of: impl Fn(&Vector3<f64>) -> nalgebra::Vector4<f64>,
) -> Option<Rigid> {
    let depth = |p: &Vector3<f64>| weights_of(p).iter().zip(in_camera).map(|(w, c)| w * c.z).sum::<f64>();
    let n_behind = points.map(|(p, _)| if depth(&p) < 0.0 { 1_i64 } else { -1 }).sum::<i64>();
    let sign = if n_behind > 0 { -1.0 } else { 1.0 };
    let (from, to) =
        (control.iter().sum::<Vector3<f64>>() / 4.0, in_camera.iter().sum::<Vector3<f64>>() * (sign / 4.0));
    let cross: Matrix3<f64> =
        control.iter().zip(in_camera).map(|(a, b)| (b * sign - to) * (a - from).transpose()).sum();
    let svd = cross.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, libm::copysign(1.0, (u * v_t).determinant())));
    let rotation = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(u * mirror * v_t));
    Some(Rigid::from_parts(Translation3::from(to - rotation * from), rotation))
}

fn squared_error(pose: &Rigid, p: &Vector3<f64>, seen_z1: &Vector2<f64>) -> f64 {
    let q = pose.rotation * p + pose.translation.vector;
    if q.z > 0.0 { (q.xy() / q.z - seen_z1).norm_squared() } else { f64::INFINITY }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::{Rng, se3};
    use nalgebra::Vector6;
    use std::vec::Vec;

    fn scene(n: usize, truth: &Rigid, noise_z1: f64, depth_m: [f64; 2]) -> Vec<(Vector3<f64>, Vector2<f64>)> {
        let mut rng = Rng::new(17, n as u64, 0);
        (0..n)
            .map(|_| {
                let z = depth_m[0] + (depth_m[1] - depth_m[0]) * rng.unit_f64();
                let q = Vector3::new((rng.unit_f64() - 0.5) * 1.4 * z, (rng.unit_f64() - 0.5) * 0.6 * z, z);
                let p = truth.inverse() * nalgebra::Point3::from(q);
                let noise = Vector2::new(rng.unit_f64() - 0.5, rng.unit_f64() - 0.5) * noise_z1;
                (p.coords, q.xy() / q.z + noise)
            })
            .collect()
    }

    #[test]
    fn the_pose_is_found_without_a_start() {
        let check = |twist: [f64; 6], n: usize, noise_z1: f64, depth_m: [f64; 2], at_most: f64| {
            let truth = se3::exp(&Vector6::from(twist));
            let found = epnp(scene(n, &truth, noise_z1, depth_m).into_iter()).expect("enough points");
            let off = se3::log(&(found * truth.inverse())).norm();
            assert!(off < at_most, "{twist:?}, {n} points: {off}");
        };
        check([0.0, 0.0, 0.0, 0.0, 0.0, 0.0], 100, 0.0, [4.0, 40.0], 1e-6);
        check([0.1, -2.5, 0.3, 5.0, -1.0, 8.0], 100, 0.0, [4.0, 40.0], 1e-6);
        check([0.0, 0.4, 0.0, 1.0, 0.2, -3.0], 6, 0.0, [5.0, 20.0], 1e-3);
        check([0.0, 0.4, 0.0, 1.0, 0.2, -3.0], 200, 1e-3, [5.0, 40.0], 0.05);
    }

    #[test]
    fn what_does_not_fix_the_pose_is_refused() {
        let truth = se3::exp(&Vector6::new(0.0, 0.1, 0.0, 0.5, 0.0, 1.0));
        assert_eq!(epnp(scene(4, &truth, 0.0, [4.0, 40.0]).into_iter()), None);
        let flat = scene(50, &Rigid::identity(), 0.0, [10.0, 10.0]);
        assert_eq!(epnp(flat.into_iter()), None);
    }
}
