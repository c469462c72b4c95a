//! One edge: its residual, and what it adds to the normal equations.

use super::block::product;
use crate::conventions::Similarity;
use crate::math::sim3::{self, Matrix7, Tangent7};

/// `log(Z^-1 S_i^-1 S_j)` with `Z^-1 = measured_j_from_i`.
pub(super) fn residual(
    measured_j_from_i: &Similarity,
    world_from_i: &Similarity,
    world_from_j: &Similarity,
) -> Tangent7 {
    sim3::log(&(measured_j_from_i * (world_from_i.inverse() * world_from_j)))
}

/// Derivatives of the residual by the right increments `S exp(e)` of both ends, which are the left increments of
/// `node_from_world` with the other sign.
pub(super) struct Linearized {
    pub(super) residual: Tangent7,
    pub(super) by_i: Matrix7,
    pub(super) by_j: Matrix7,
}

impl Linearized {
    pub(super) fn new(
        measured_j_from_i: &Similarity,
        world_from_i: &Similarity,
        world_from_j: &Similarity,
        is_scale_free: bool,
    ) -> Self {
        let i_from_j = world_from_i.inverse() * world_from_j;
        let residual = sim3::log(&(measured_j_from_i * i_from_j));
        let mut by_j = sim3::left_jacobian_inverse(&-residual);
        let mut by_i = -product(&by_j, &sim3::adjoint(&i_from_j.inverse()));
        if !is_scale_free {
            by_i.column_mut(6).fill(0.0);
            by_j.column_mut(6).fill(0.0);
        }
        Self { residual, by_i, by_j }
    }
}

/// Blocks of the normal equations of one edge.
pub(super) struct Share {
    pub(super) ii: Matrix7,
    pub(super) ji: Matrix7,
    pub(super) jj: Matrix7,
    pub(super) gradient_i: Tangent7,
    pub(super) gradient_j: Tangent7,
}

impl Share {
    pub(super) fn new(edge: &Linearized, information: &Matrix7) -> Self {
        let weighted_i = product(information, &edge.by_i);
        let weighted_j = product(information, &edge.by_j);
        let (transposed_i, transposed_j) = (edge.by_i.transpose(), edge.by_j.transpose());
        Self {
            ii: product(&transposed_i, &weighted_i),
            ji: product(&transposed_j, &weighted_i),
            jj: product(&transposed_j, &weighted_j),
            gradient_i: weighted_i.tr_mul(&edge.residual),
            gradient_j: weighted_j.tr_mul(&edge.residual),
        }
    }
}
