//! From a Gaussian in its keyframe's frame to a splat on the picture, and gradients back.

use super::decode::Decoded;
use super::lane::{Lane, each};
use crate::splat::View;
pub use crate::splat::kernel_constants::{NEAR_PLANE_M, SCREEN_DILATION_PX2};

/// The projection is linearised at most this share of the half field of view beyond the border of the picture.
const FIELD_OF_VIEW_MARGIN: f64 = 0.3;

/// What the projection needs of the camera.
#[derive(Clone, Copy, Debug)]
pub struct CameraConstants {
    /// Focal lengths, px.
    pub focal_px: [f64; 2],
    /// Principal point, px.
    pub center_px: [f64; 2],
    /// Smallest x/z and y/z at which the projection is linearised.
    pub min_z1: [f64; 2],
    /// Largest x/z and y/z at which the projection is linearised.
    pub max_z1: [f64; 2],
}

impl CameraConstants {
    /// Constants of a view.
    pub fn of(view: &View) -> Self {
        let camera = &view.camera;
        let focal_px = [camera.fx, camera.fy];
        let center_px = [camera.cx, camera.cy];
        let size_px = [f64::from(camera.width), f64::from(camera.height)];
        let margin_z1 = each!(i in 2 => FIELD_OF_VIEW_MARGIN * 0.5 * size_px[i] / focal_px[i]);
        Self {
            focal_px,
            center_px,
            min_z1: each!(i in 2 => -center_px[i] / focal_px[i] - margin_z1[i]),
            max_z1: each!(i in 2 => (size_px[i] - center_px[i]) / focal_px[i] + margin_z1[i]),
        }
    }
}

/// `x_camera = linear * x_keyframe + translation`; `linear` is scale times rotation, row by row.
#[derive(Clone, Copy, Debug)]
pub struct CameraFromKeyframe<L> {
    /// Scale times rotation, `[row][column]`.
    pub linear: [[L; 3]; 3],
    /// Translation, m.
    pub translation: [L; 3],
}

/// A projected Gaussian, with what its gradient needs again.
#[derive(Clone, Copy, Debug)]
pub struct Projected<L> {
    /// Mean on the picture, px.
    pub mean_px: [L; 2],
    /// Depth along the optical axis, m.
    pub depth_m: L,
    /// Covariance `[xx, xy, yy]` with the dilation, px^2.
    pub covariance_px2: [L; 3],
    /// Its inverse `[xx, xy, yy]`.
    pub conic: [L; 3],
    mean_in_camera: [L; 3],
    /// Where the projection is linearised.
    linearised_z1: [L; 2],
    /// Rotation of the Gaussian, `[row][column]`.
    rotation: [[L; 3]; 3],
    /// `camera_from_keyframe.linear * rotation * diag(scale)`: a square root of the covariance in the camera's frame.
    root: [[L; 3]; 3],
    /// `jacobian * root`: a square root of the covariance on the picture.
    root_px: [[L; 3]; 2],
}

/// Gradients with respect to what is blended.
#[derive(Clone, Copy, Debug)]
pub struct SplatGradient<L> {
    /// With respect to the mean, px.
    pub mean_px: [L; 2],
    /// With respect to the conic's `[xx, xy, yy]` in `q = xx dx^2 / 2 + xy dx dy + yy dy^2 / 2`.
    pub conic: [L; 3],
    /// With respect to the opacity.
    pub opacity: L,
    /// With respect to the color.
    pub color: [L; 3],
    /// With respect to the depth.
    pub depth: L,
}

/// EWA projection of one Gaussian per lane; lanes at or behind the near plane give numbers without meaning.
///
/// # Source
/// Zwicker et al. 2002, eq. 24-31; clamp of the linearisation point: Kerbl et al. 2023, as documented by gsplat.
#[inline(always)]
pub fn project<L: Lane>(camera: &CameraConstants, placement: &CameraFromKeyframe<L>, g: &Decoded<L>) -> Projected<L> {
    let mean_in_camera = each!(i in 3 => dot(&placement.linear[i], &g.mean) + placement.translation[i]);
    let [x, y, z] = mean_in_camera;
    let inverse_z = z.constant(1.0) / z;
    let z1 = [x * inverse_z, y * inverse_z];
    let linearised_z1 = each!(i in 2 => z1[i].clamp(z.constant(camera.min_z1[i]), z.constant(camera.max_z1[i])));
    let rotation = rotation_matrix(&g.rotation);
    let oriented = each!(i in 3 => each!(j in 3 => rotation[i][j] * g.scale[j]));
    let root = multiply(&placement.linear, &oriented);
    let root_px = each!(i in 2 => {
        let along = z.constant(camera.focal_px[i]) * inverse_z;
        each!(j in 3 => along * (root[i][j] - linearised_z1[i] * root[2][j]))
    });
    let dilation = z.constant(SCREEN_DILATION_PX2);
    let xx = dot(&root_px[0], &root_px[0]) + dilation;
    let xy = dot(&root_px[0], &root_px[1]);
    let yy = dot(&root_px[1], &root_px[1]) + dilation;
    // Lagrange's identity: no difference of large products, which would leave nothing of a needle's determinant in f32.
    let normal = cross(&root_px[0], &root_px[1]);
    let determinant = dilation.mul_add(xx + yy - dilation, dot(&normal, &normal));
    let inverse_determinant = z.constant(1.0) / determinant;
    Projected {
        mean_px: each!(i in 2 => z1[i].mul_add(z.constant(camera.focal_px[i]), z.constant(camera.center_px[i]))),
        depth_m: z,
        covariance_px2: [xx, xy, yy],
        conic: [yy * inverse_determinant, -xy * inverse_determinant, xx * inverse_determinant],
        mean_in_camera,
        linearised_z1,
        rotation,
        root,
        root_px,
    }
}

/// Gradients with respect to what is projected.
#[derive(Clone, Copy, Debug)]
pub struct ProjectedGradient<L> {
    /// With respect to the Gaussian in its keyframe's frame.
    pub gaussian: Decoded<L>,
    mean_in_camera: [L; 3],
    root: [[L; 3]; 3],
}

impl<L: Lane> ProjectedGradient<L> {
    /// With respect to a left increment `[omega, upsilon]` of the camera's pose: a mean moves by `omega x mean +
    /// upsilon`, the columns of the covariance's root turn by `omega x column`.
    ///
    /// # Source
    /// Sola, Deray & Atchuthan 2018, eq. 182-183.
    #[inline(always)]
    pub fn pose(&self, p: &Projected<L>) -> [L; 6] {
        let mut turn = cross(&p.mean_in_camera, &self.mean_in_camera);
        for j in 0..3 {
            let by_axis = cross(&column(&p.root, j), &column(&self.root, j));
            turn = each!(i in 3 => turn[i] + by_axis[i]);
        }
        let [x, y, z] = self.mean_in_camera;
        [turn[0], turn[1], turn[2], x, y, z]
    }
}

/// Gradients with respect to the decoded Gaussian, from those with respect to its splat.
///
/// # Source
/// Derivative of [`project`]; checked against central differences and against `../shared/golden`.
#[inline(always)]
pub fn project_backward<L: Lane>(
    camera: &CameraConstants,
    placement: &CameraFromKeyframe<L>,
    g: &Decoded<L>,
    p: &Projected<L>,
    grad: &SplatGradient<L>,
) -> ProjectedGradient<L> {
    let grad_root_px = root_px_backward(p, &grad.conic);
    let [x, y, z] = p.mean_in_camera;
    let inverse_z = z.constant(1.0) / z;
    let mut grad_root = [[z.zero(); 3]; 3];
    let mut grad_mean = [z.zero(), z.zero(), grad.depth];
    for i in 0..2 {
        let along = z.constant(camera.focal_px[i]) * inverse_z;
        let value_z1 = [x, y][i] * inverse_z;
        for j in 0..3 {
            grad_root[i][j] = along * grad_root_px[i][j];
            grad_root[2][j] = grad_root[2][j] - p.linearised_z1[i] * grad_root[i][j];
        }
        // root_px scales with 1/z, and moves with the linearisation point where that is not clamped.
        let grad_along = dot(&grad_root_px[i], &p.root_px[i]);
        let inside = z.and(z.constant(camera.min_z1[i]).lt(value_z1), value_z1.lt(z.constant(camera.max_z1[i])));
        let grad_linearised = z.zero().replace(inside, -along * dot(&grad_root_px[i], &p.root[2]));
        let grad_z1 = grad_linearised + grad.mean_px[i] * z.constant(camera.focal_px[i]);
        grad_mean[i] = grad_z1 * inverse_z;
        grad_mean[2] = grad_mean[2] - (grad_along + grad_z1 * value_z1) * inverse_z;
    }
    let grad_oriented = multiply_transposed(&placement.linear, &grad_root);
    let grad_rotation = each!(i in 3 => each!(j in 3 => grad_oriented[i][j] * g.scale[j]));
    let gaussian = Decoded {
        mean: each!(j in 3 => dot(&column(&placement.linear, j), &grad_mean)),
        rotation: rotation_backward(&g.rotation, &grad_rotation),
        scale: each!(j in 3 => dot(&column(&p.rotation, j), &column(&grad_oriented, j))),
        opacity: grad.opacity,
        color: grad.color,
    };
    ProjectedGradient { gaussian, mean_in_camera: grad_mean, root: grad_root }
}

#[inline(always)]
fn column<L: Lane>(m: &[[L; 3]; 3], j: usize) -> [L; 3] {
    [m[0][j], m[1][j], m[2][j]]
}

/// Through `conic = (root_px root_px^T + dilation)^-1`: `dCov = -conic dConic conic`, `dRoot = 2 dCov root`.
#[inline(always)]
fn root_px_backward<L: Lane>(p: &Projected<L>, grad_conic: &[L; 3]) -> [[L; 3]; 2] {
    let [a, b, c] = p.conic;
    let half = a.constant(0.5);
    let (da, db, dc) = (grad_conic[0], grad_conic[1] * half, grad_conic[2]);
    // (conic * dConic), then times conic.
    let (m00, m01) = (a * da + b * db, a * db + b * dc);
    let (m10, m11) = (b * da + c * db, b * db + c * dc);
    let minus_two = a.constant(-2.0);
    let xx = minus_two * (m00 * a + m01 * b);
    let xy = minus_two * (m00 * b + m01 * c);
    let yy = minus_two * (m10 * b + m11 * c);
    let [r0, r1] = &p.root_px;
    [each!(j in 3 => xx * r0[j] + xy * r1[j]), each!(j in 3 => xy * r0[j] + yy * r1[j])]
}

#[inline(always)]
fn dot<L: Lane>(a: &[L; 3], b: &[L; 3]) -> L {
    a[0].mul_add(b[0], a[1].mul_add(b[1], a[2] * b[2]))
}

#[inline(always)]
fn cross<L: Lane>(a: &[L; 3], b: &[L; 3]) -> [L; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

#[inline(always)]
fn multiply<L: Lane>(a: &[[L; 3]; 3], b: &[[L; 3]; 3]) -> [[L; 3]; 3] {
    each!(i in 3 => each!(j in 3 => dot(&a[i], &[b[0][j], b[1][j], b[2][j]])))
}

/// `a^T b`.
#[inline(always)]
fn multiply_transposed<L: Lane>(a: &[[L; 3]; 3], b: &[[L; 3]; 3]) -> [[L; 3]; 3] {
    each!(i in 3 => each!(j in 3 => dot(&[a[0][i], a[1][i], a[2][i]], &[b[0][j], b[1][j], b[2][j]])))
}

/// Rotation matrix `[row][column]` of a unit quaternion xyzw.
#[inline(always)]
fn rotation_matrix<L: Lane>(q: &[L; 4]) -> [[L; 3]; 3] {
    let [x, y, z, w] = *q;
    let one = x.constant(1.0);
    let two = x.constant(2.0);
    [
        [one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
        [two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)],
        [two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)],
    ]
}

/// Gradient with respect to the quaternion's components, from that with respect to the rotation matrix.
#[inline(always)]
fn rotation_backward<L: Lane>(q: &[L; 4], d: &[[L; 3]; 3]) -> [L; 4] {
    let [x, y, z, w] = *q;
    let two = x.constant(2.0);
    let (xy, xz, yz) = (d[0][1] + d[1][0], d[0][2] + d[2][0], d[1][2] + d[2][1]);
    let (about_x, about_y, about_z) = (d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]);
    [
        two * (y * xy + z * xz + w * about_x - two * x * (d[1][1] + d[2][2])),
        two * (x * xy + z * yz + w * about_y - two * y * (d[0][0] + d[2][2])),
        two * (x * xz + y * yz + w * about_z - two * z * (d[0][0] + d[1][1])),
        two * (x * about_x + y * about_y + z * about_z),
    ]
}
