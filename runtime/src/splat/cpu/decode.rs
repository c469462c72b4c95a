//! From trained numbers to Gaussians in their keyframe's frame, and gradients back.
//!
//! This stage is the one that a learned decoder replaces; nothing after it knows how a Gaussian came about.

use super::lane::{Lane, each};
use crate::splat::kernel_constants::MIN_QUATERNION_NORM2;

/// Position of each group within the 14 trained numbers of a Gaussian (the layout of
/// [`GaussianParams`](kilogs_core::map::GaussianParams)).
pub mod group {
    use crate::splat::kernel_constants as constants;

    /// Offsets, 3 numbers.
    pub const OFFSET: usize = 0;
    /// Logarithms of scales, 3 numbers.
    pub const LOG_SCALE: usize = constants::FIRST_LOG_SCALE as usize;
    /// Quaternion xyzw.
    pub const ROTATION: usize = constants::FIRST_ROTATION as usize;
    /// Opacity logit.
    pub const OPACITY: usize = constants::FIRST_OPACITY as usize;
    /// Color logits, 3 numbers.
    pub const COLOR: usize = constants::FIRST_COLOR as usize;
}

/// Trained numbers per Gaussian.
pub const N_PARAMS: usize = kilogs_core::map::anchor::GAUSSIAN_PARAMS;

/// A Gaussian in its keyframe's frame, or gradients with respect to it.
#[derive(Clone, Copy, Debug)]
pub struct Decoded<L> {
    /// Mean, m.
    pub mean: [L; 3],
    /// Unit quaternion xyzw.
    pub rotation: [L; 4],
    /// Standard deviations along its axes, m.
    pub scale: [L; 3],
    /// Opacity in (0, 1).
    pub opacity: L,
    /// RGB in (0, 1).
    pub color: [L; 3],
}

/// What the anchor contributes.
#[derive(Clone, Copy, Debug)]
pub struct AnchorLanes<L> {
    /// Position in the keyframe, m.
    pub position: [L; 3],
    /// Extent per axis, m.
    pub extent: [L; 3],
}

/// `mean = position + offset * extent`, `scale = extent * exp(log_scale)`, logistic opacity and color.
///
/// # Source
/// Own definition, see [`GaussianParams`](kilogs_core::map::GaussianParams); the anchor form is that of Lu et al. 2024, eq. 3.
#[inline(always)]
pub fn decode<L: Lane>(anchor: &AnchorLanes<L>, params: &[L; N_PARAMS]) -> Decoded<L> {
    let inverse_norm = inverse_quaternion_norm(params);
    Decoded {
        mean: each!(i in 3 => params[group::OFFSET + i].mul_add(anchor.extent[i], anchor.position[i])),
        rotation: each!(i in 4 => params[group::ROTATION + i] * inverse_norm),
        scale: each!(i in 3 => anchor.extent[i] * params[group::LOG_SCALE + i].exp()),
        opacity: params[group::OPACITY].sigmoid(),
        color: each!(i in 3 => params[group::COLOR + i].sigmoid()),
    }
}

/// Gradients with respect to the trained numbers, from those with respect to the decoded Gaussian.
///
/// # Source
/// Derivative of [`decode`]; checked against central differences.
#[inline(always)]
pub fn decode_backward<L: Lane>(
    anchor: &AnchorLanes<L>,
    params: &[L; N_PARAMS],
    decoded: &Decoded<L>,
    grad: &Decoded<L>,
) -> [L; N_PARAMS] {
    let one = decoded.opacity.constant(1.0);
    let inverse_norm = inverse_quaternion_norm(params);
    let (q, dq) = (&decoded.rotation, &grad.rotation);
    let along = q[0] * dq[0] + q[1] * dq[1] + q[2] * dq[2] + q[3] * dq[3];
    let mut out = [one.zero(); N_PARAMS];
    for i in 0..3 {
        out[group::OFFSET + i] = grad.mean[i] * anchor.extent[i];
        out[group::LOG_SCALE + i] = grad.scale[i] * decoded.scale[i];
        out[group::COLOR + i] = grad.color[i] * decoded.color[i] * (one - decoded.color[i]);
    }
    for i in 0..4 {
        out[group::ROTATION + i] = (dq[i] - q[i] * along) * inverse_norm;
    }
    out[group::OPACITY] = grad.opacity * decoded.opacity * (one - decoded.opacity);
    out
}

#[inline(always)]
fn inverse_quaternion_norm<L: Lane>(params: &[L; N_PARAMS]) -> L {
    let [x, y, z, w] = each!(i in 4 => params[group::ROTATION + i]);
    let norm2 = x * x + y * y + z * z + w * w;
    norm2.constant(1.0) / norm2.max(norm2.constant(MIN_QUATERNION_NORM2)).sqrt()
}
