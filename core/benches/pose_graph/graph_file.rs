//! The graphs that `peers.py` stores, and memory to optimise them in.

use kilogs_core::conventions::{Similarity, rotation_from_xyzw};
use kilogs_core::math::sim3::Matrix7;
use kilogs_core::pose::align_similarity;
use kilogs_core::pose_graph::{
    Column, FactorBlock, GraphCapacities, Junction, LoopEdge, LoopMeasurement, Node, Place, PoseGraph, PushProblem,
    SolverStorage, information_of_sigmas,
};
use nalgebra::{Isometry3, Point3, Translation3, Vector3};
use std::path::Path;

/// How far a lie moves a loop, m.
const LIE_M: f64 = 30.0;

/// A drive with its loops.
pub struct GraphFile {
    truth: Vec<Vector3<f64>>,
    odometry_from_node: Vec<Similarity>,
    loops: Vec<(usize, usize, Similarity)>,
    /// Of a step, of a loop.
    information: [Matrix7; 2],
}

impl GraphFile {
    /// Reads the lines that `peers.py` describes.
    pub fn read(path: &Path) -> std::io::Result<Self> {
        let mut file = Self {
            truth: Vec::new(),
            odometry_from_node: vec![Similarity::identity()],
            loops: Vec::new(),
            information: [Matrix7::identity(); 2],
        };
        for line in std::fs::read_to_string(path)?.lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            let numbers: Vec<f64> = words.iter().filter_map(|w| w.parse().ok()).collect();
            match (words.first().copied(), numbers.as_slice()) {
                (Some("sigmas"), &[r, t, s]) => {
                    file.information[usize::from(words[1] == "loop")] = information_of_sigmas(r, t, s);
                }
                (Some("truth"), &[x, y, z]) => file.truth.push(Vector3::new(x, y, z)),
                (Some("odometry"), step) if step.len() == 8 => {
                    let last = file.odometry_from_node[file.odometry_from_node.len() - 1];
                    file.odometry_from_node.push(last * similarity(step));
                }
                (Some("loop"), &[i, j, ref rest @ ..]) if rest.len() == 8 => {
                    file.loops.push((i as usize, j as usize, similarity(rest)));
                }
                _ => return Err(std::io::Error::other(format!("{}: not a graph line: {line}", path.display()))),
            }
        }
        Ok(file)
    }

    /// Drives it once more; every `lie_every`-th loop is a lie.
    pub fn fill(&self, graph: &mut PoseGraph<'_>, lie_every: Option<usize>) -> Result<(), PushProblem> {
        for (k, odometry_from_node) in self.odometry_from_node.iter().enumerate() {
            graph.push_node(k as u32, odometry_from_node, &self.information[0])?;
        }
        let place = |k: usize| Place { keyframe_id: k as u32, odometry_from_keyframe: self.odometry_from_node[k] };
        for (k, &(i, j, from_from_to)) in self.loops.iter().enumerate() {
            let is_lie = lie_every.is_some_and(|n| k % n == n - 1);
            let off = Translation3::new(if is_lie { LIE_M } else { 0.0 }, 0.0, 0.0);
            let off = Similarity::from_isometry(off.into(), 1.0);
            let (from, to) = (place(i), place(j));
            let information = self.information[1];
            graph.push_loop(&LoopMeasurement { from, to, from_from_to: off * from_from_to, information })?;
        }
        Ok(())
    }

    /// Root mean square of the places' errors after the similarity that fits best, m.
    pub fn ate_m(&self, graph: &PoseGraph<'_>) -> f64 {
        let pairs = (0..graph.n_nodes()).filter_map(|k| {
            let place = graph.world_from_node(k)? * Point3::origin();
            Some((place.coords, self.truth[graph.keyframe_id(k)? as usize]))
        });
        let Some(truth_from_world) = align_similarity(pairs.clone()) else { return f64::NAN };
        let squared =
            pairs.map(|(place, truth)| (truth_from_world * Point3::from(place) - truth).coords.norm_squared());
        (squared.sum::<f64>() / graph.n_nodes() as f64).sqrt()
    }
}

fn similarity(numbers: &[f64]) -> Similarity {
    let [x, y, z, qx, qy, qz, qw, scale] = core::array::from_fn(|k| numbers[k]);
    let rotation = rotation_from_xyzw([qx, qy, qz, qw]);
    Similarity::from_isometry(Isometry3::from_parts(Translation3::new(x, y, z), rotation), scale)
}

/// Memory of one graph and its solver.
pub struct Memory {
    nodes: Vec<Node>,
    loops: Vec<LoopEdge>,
    columns: Vec<Column>,
    junctions: Vec<Junction>,
    neighbors: Vec<u64>,
    blocks: Vec<FactorBlock>,
}

impl Memory {
    /// As much as the capacities say.
    pub fn new(capacities: &GraphCapacities) -> Self {
        Self {
            nodes: vec![Node::default(); capacities.nodes],
            loops: vec![LoopEdge::default(); capacities.loops],
            columns: vec![Column::default(); capacities.nodes],
            junctions: vec![Junction::default(); capacities.junctions()],
            neighbors: vec![0; capacities.neighbor_words()],
            blocks: vec![FactorBlock::default(); capacities.blocks],
        }
    }

    /// An empty graph and a solver.
    pub fn split(&mut self) -> (PoseGraph<'_>, SolverStorage<'_>) {
        let work = SolverStorage {
            columns: &mut self.columns,
            junctions: &mut self.junctions,
            neighbors: &mut self.neighbors,
            blocks: &mut self.blocks,
        };
        (PoseGraph::new(&mut self.nodes, &mut self.loops), work)
    }
}
