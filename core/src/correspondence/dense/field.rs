//! What neighbours agree on: the flow of a node, and the shape that windows around it take.

use super::DenseSettings;
use super::storage::Grid;
use super::volume::{BYTES_PER_NODE, REACH, SIDE, node_pixel};
use crate::correspondence::local_flow::{Place, fit};

/// A point of the grid on its way through the levels.
#[derive(Clone, Copy, Debug)]
pub struct DenseNode {
    pub(super) keyframe_px: [f32; 2],
    pub(super) current_px: [f32; 2],
    /// How offsets around the node are deformed: rows of the linear map.
    pub(super) shape: [[f32; 2]; 2],
    /// Whether `current_px` was found, and by this node.
    pub(super) is_alive: bool,
    /// Share of the neighbours that agree.
    pub(super) support: f32,
    /// Correlation of the windows at half the resolution.
    pub(super) correlation: f32,
    /// Expected standard deviation of `current_px`.
    pub(super) sigma_px: f32,
}

impl DenseNode {
    /// Fills storage that is still to be written.
    pub const NONE: Self = Self {
        keyframe_px: [0.0; 2],
        current_px: [0.0; 2],
        shape: [[1.0, 0.0], [0.0, 1.0]],
        is_alive: false,
        support: 0.0,
        correlation: 0.0,
        sigma_px: f32::INFINITY,
    };

    /// From 0 to 1.
    pub(super) fn confidence(&self) -> f32 {
        self.correlation.max(0.0) * self.support.min(1.0) / (1.0 + self.sigma_px * self.sigma_px)
    }

    fn displacement(&self) -> [f32; 2] {
        [self.current_px[0] - self.keyframe_px[0], self.current_px[1] - self.keyframe_px[1]]
    }
}

/// Sets every node to its best displacement.
pub(super) fn read_out(grid: &Grid, volume: &[u8], nodes: &mut [DenseNode]) {
    let scale = (1u32 << grid.level) as f32;
    for (i, (node, scores)) in nodes.iter_mut().zip(volume.chunks_exact(BYTES_PER_NODE)).enumerate() {
        let (x, y) = node_pixel(grid, i);
        let (best, distinctness) = peak(scores);
        let offset = [best % SIDE, best / SIDE].map(|k| (k as f32 - REACH as f32) * scale);
        let keyframe_px = [x, y].map(|c| (c as f32 + 0.5) * scale);
        *node = DenseNode {
            keyframe_px,
            current_px: [keyframe_px[0] + offset[0], keyframe_px[1] + offset[1]],
            is_alive: distinctness > 0.0,
            ..DenseNode::NONE
        };
    }
}

/// The best displacement, and by which share it beats the best one that is not its neighbour.
fn peak(scores: &[u8]) -> (usize, f32) {
    /// Displacements closer than this belong to the same peak, level px.
    const PEAK_RADIUS: usize = 3;
    let (mut best, mut best_score) = (0, 0);
    for (k, &score) in scores.iter().enumerate() {
        if score > best_score {
            (best, best_score) = (k, score);
        }
    }
    let (x, y) = (best % SIDE, best / SIDE);
    let mut second = 0;
    for (dy, row) in scores.chunks_exact(SIDE).enumerate() {
        for (dx, &score) in row.iter().enumerate() {
            if score > second && (dx.abs_diff(x) > PEAK_RADIUS || dy.abs_diff(y) > PEAK_RADIUS) {
                second = score;
            }
        }
    }
    let distinctness = if best_score > 0 { 1.0 - f32::from(second) / f32::from(best_score) } else { 0.0 };
    (best, distinctness)
}

/// How far a flow may be from that of a node nearby.
#[derive(Clone, Copy, Debug)]
pub(super) struct Tolerance {
    /// Next to it, px.
    pub(super) near_px: f32,
    /// More per px of distance: how much the image may be zoomed, turned or sheared.
    pub(super) per_px: f32,
}

/// Nodes on each side that count as neighbours.
const NEIGHBOURHOOD: i32 = 2;
const MOST_NEIGHBOURS: usize = 24;

/// Neighbours that have to agree at least, whatever their share.
const MIN_SUPPORTERS: usize = 4;

/// Lets the neighbours of every node vote.
///
/// A node that enough of them agree with stays, and gets its shape from them. Another one takes over what they agree on,
/// and is dropped when that is nothing.
pub(super) fn agree(
    grid: &Grid,
    tolerance: Tolerance,
    min_support: f32,
    nodes: &mut [DenseNode],
    before: &mut [DenseNode],
) {
    let before = &mut before[..nodes.len()];
    before.copy_from_slice(nodes);
    for (i, node) in nodes.iter_mut().enumerate() {
        let own = before[i];
        let (neighbours, n) = neighbours(grid, i, before);
        let neighbours = &neighbours[..n];
        let own_votes = if own.is_alive { votes(&own, neighbours, tolerance) } else { 0 };
        let enough = |votes: usize| votes >= MIN_SUPPORTERS && votes as f32 >= min_support * n as f32;
        let chosen = if enough(own_votes) {
            Some((own, own_votes))
        } else {
            let counted = neighbours.iter().map(|other| (*other, votes(other, neighbours, tolerance) - 1));
            counted.reduce(|a, b| if b.1 > a.1 { b } else { a }).filter(|chosen| enough(chosen.1))
        };
        let Some((chosen, votes)) = chosen else {
            node.is_alive = false;
            continue;
        };
        let all = neighbours.iter().chain(own.is_alive.then_some(&own));
        let agreeing = all.filter(|other| agrees(&chosen, other, tolerance));
        let places = agreeing.map(|other| Place { keyframe_px: other.keyframe_px, current_px: other.current_px });
        let flow = chosen.displacement();
        let start = Place {
            keyframe_px: own.keyframe_px,
            current_px: [own.keyframe_px[0] + flow[0], own.keyframe_px[1] + flow[1]],
        };
        let (current_px, shape) = fit(&start, DenseNode::NONE.shape, 0.5 * tolerance.near_px, places);
        node.shape = shape;
        node.support = votes as f32 / n as f32;
        if !enough(own_votes) {
            (node.is_alive, node.current_px, node.sigma_px) = (true, current_px, f32::INFINITY);
        }
    }
}

/// Drops the nodes that were not found, that lie elsewhere than their neighbours' flow, continued linearly, expects them, or whose neighbours
/// follow no common flow.
pub(super) fn keep_consistent(
    grid: &Grid,
    settings: &DenseSettings,
    nodes: &mut [DenseNode],
    before: &mut [DenseNode],
) {
    for node in nodes.iter_mut() {
        node.is_alive &= node.sigma_px.is_finite();
    }
    let before = &mut before[..nodes.len()];
    before.copy_from_slice(nodes);
    for (i, node) in nodes.iter_mut().enumerate().filter(|(_, node)| node.is_alive) {
        let (neighbours, n) = neighbours(grid, i, before);
        let [[a, b], [c, d]] = node.shape;
        let follows = |other: &&DenseNode| {
            let [dx, dy] = [0, 1].map(|k: usize| other.keyframe_px[k] - node.keyframe_px[k]);
            let expected = [node.current_px[0] + a * dx + b * dy, node.current_px[1] + c * dx + d * dy];
            let limit_px = settings.max_deviation_px + settings.max_deviation_per_px * dx.abs().max(dy.abs());
            (0..2).all(|k| (other.current_px[k] - expected[k]).abs() <= limit_px)
        };
        let supporters = neighbours[..n].iter().filter(follows).count();
        node.is_alive = supporters >= MIN_SUPPORTERS && supporters as f32 >= settings.min_support * n as f32;
        node.support = supporters as f32 / MOST_NEIGHBOURS as f32;
    }
}

fn neighbours(grid: &Grid, i: usize, nodes: &[DenseNode]) -> ([DenseNode; MOST_NEIGHBOURS], usize) {
    let (column, row) = ((i % grid.columns) as i32, (i / grid.columns) as i32);
    let mut found = [DenseNode::NONE; MOST_NEIGHBOURS];
    let mut n = 0;
    for y in (row - NEIGHBOURHOOD).max(0)..=(row + NEIGHBOURHOOD).min(grid.rows as i32 - 1) {
        for x in (column - NEIGHBOURHOOD).max(0)..=(column + NEIGHBOURHOOD).min(grid.columns as i32 - 1) {
            let k = y as usize * grid.columns + x as usize;
            if k != i && nodes[k].is_alive {
                found[n] = nodes[k];
                n += 1;
            }
        }
    }
    (found, n)
}

/// Neighbours whose flow is close to that of `node`; counts `node` itself when it is among them.
fn votes(node: &DenseNode, neighbours: &[DenseNode], tolerance: Tolerance) -> usize {
    neighbours.iter().filter(|other| agrees(node, other, tolerance)).count()
}

fn agrees(a: &DenseNode, b: &DenseNode, tolerance: Tolerance) -> bool {
    let (flow_a, flow_b) = (a.displacement(), b.displacement());
    let apart = |u: [f32; 2], v: [f32; 2]| (u[0] - v[0]).abs().max((u[1] - v[1]).abs());
    apart(flow_a, flow_b) <= tolerance.near_px + tolerance.per_px * apart(a.keyframe_px, b.keyframe_px)
}

/// How far neighbours may differ when they were found on `level`.
pub(super) fn tolerance(level: usize) -> Tolerance {
    /// On the full image; a level knows its flow to about a pixel of its own.
    const NEAR_PX: f32 = 1.0;
    const PER_PX: f32 = 0.5;
    Tolerance { near_px: NEAR_PX * (1u32 << level) as f32, per_px: PER_PX }
}
