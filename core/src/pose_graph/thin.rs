//! Makes room in a full skeleton.

use super::{Node, PoseGraph};
use crate::math::sim3::{Matrix7, adjoint};

/// One node in so many is given up at a time, so that thinning is rare.
const SHARE: usize = 8;

impl PoseGraph<'_> {
    /// Gives up nodes that no loop touches, where the skeleton is densest, the oldest first and never two neighbors. The
    /// edges on both sides of such a node become one.
    pub(super) fn thin(&mut self) {
        self.mark_loop_ends();
        let most = (self.n_nodes / SHARE).max(1);
        let densest =
            (1..self.n_nodes.saturating_sub(1)).filter(|&k| !self.nodes[k].is_loop_end).map(|k| self.gap(k)).min();
        let Some(densest) = densest else { return };
        // Gaps of similar size count as equal, so that the skeleton is halved evenly.
        let limit = densest.checked_next_power_of_two().unwrap_or(densest);
        let (mut n_kept, mut k) = (1, 1);
        let mut n_removed = 0;
        while k < self.n_nodes {
            let is_inside = k + 1 < self.n_nodes && !self.nodes[k].is_loop_end;
            if n_removed < most && is_inside && self.gap(k) <= limit {
                let (removed, mut next) = (self.nodes[k], self.nodes[k + 1]);
                next.information = composed(&removed, &next);
                self.nodes[k + 1] = next;
                // The next one stays: it has just become the end of a longer edge.
                self.nodes[n_kept] = next;
                n_removed += 1;
                k += 2;
            } else {
                self.nodes[n_kept] = self.nodes[k];
                k += 1;
            }
            n_kept += 1;
        }
        self.n_nodes = n_kept;
    }

    /// Keyframes from the node before to the node after.
    fn gap(&self, node: usize) -> u32 {
        self.nodes[node + 1].keyframe_id - self.nodes[node - 1].keyframe_id
    }

    /// A loop may have been taken back since its ends were marked.
    fn mark_loop_ends(&mut self) {
        let nodes = &mut self.nodes[..self.n_nodes];
        nodes.iter_mut().for_each(|n| n.is_loop_end = false);
        for id in self.loops[..self.n_loops].iter().flat_map(|l| [l.from_id, l.to_id]) {
            let place = nodes.partition_point(|n| n.keyframe_id < id);
            if let Some(node) = nodes.get_mut(place) {
                node.is_loop_end = true;
            }
        }
    }
}

/// Information of two odometry edges, one after the other: `Z_1 exp(r_1) Z_2 exp(r_2) = Z_1 Z_2 exp(Ad(Z_2^-1) r_1 + r_2)`
/// to first order.
fn composed(first: &Node, second: &Node) -> Matrix7 {
    let carry = adjoint(&second.node_from_previous(first));
    let covariance = |information: &Matrix7| information.cholesky().map(|c| c.inverse());
    let (Some(a), Some(b)) = (covariance(&first.information), covariance(&second.information)) else {
        // Of an edge that is no measurement nothing can be composed.
        return second.information;
    };
    covariance(&(carry * a * carry.transpose() + b)).unwrap_or(second.information)
}
