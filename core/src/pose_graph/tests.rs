//! A car on a round, and what its graph makes of drift, loops, lies and little room.

use super::edge::{Linearized, residual};
use super::*;
use crate::math::Rng;
use nalgebra::Point3;
use std::vec::Vec;

const ROUND: u32 = 60;
const SETTINGS: OptimizeSettings = OptimizeSettings {
    gauge: Gauge::First,
    extent: Extent::Whole,
    is_scale_free: true,
    max_loop_sigmas: 6.0,
    max_iterations: 30,
};

fn step_information() -> Matrix7 {
    information_of_sigmas(1e-3, 0.02, 1e-3)
}

fn noise(rng: &mut Rng, sigmas: [f64; 3]) -> Tangent7 {
    let [r, t, s] = sigmas;
    Tangent7::from([r, r, r, t, t, t, s]).map(|sigma| sigma * (0..12).map(|_| rng.unit_f64() - 0.5).sum::<f64>())
}

/// A hilly circle of 60 steps of a metre.
fn truth(keyframe_id: u32) -> Similarity {
    let turn = f64::from(keyframe_id) * std::f64::consts::TAU / f64::from(ROUND);
    let step = sim3::exp(&Tangent7::from([0.0, turn, 0.0, 0.0, 0.0, f64::from(keyframe_id % ROUND), 0.0]));
    let rounds = f64::from(keyframe_id / ROUND);
    sim3::exp(&Tangent7::from([0.0, 0.0, 0.0, 0.1 * rounds, 0.2 * turn.sin(), 0.0, 0.0])) * step
}

struct Memory {
    nodes: Vec<Node>,
    loops: Vec<LoopEdge>,
    columns: Vec<Column>,
    junctions: Vec<Junction>,
    neighbors: Vec<u64>,
    blocks: Vec<FactorBlock>,
}

impl Memory {
    fn new(nodes: usize, loops: usize, blocks: usize) -> Self {
        let capacities = GraphCapacities { nodes, loops, blocks };
        Self {
            nodes: std::vec![Node::default(); nodes],
            loops: std::vec![LoopEdge::default(); loops],
            columns: std::vec![Column::default(); nodes],
            junctions: std::vec![Junction::default(); capacities.junctions()],
            neighbors: std::vec![u64::MAX; capacities.neighbor_words()],
            blocks: std::vec![FactorBlock::default(); blocks],
        }
    }

    fn split(&mut self) -> (PoseGraph<'_>, SolverStorage<'_>) {
        let work = SolverStorage {
            columns: &mut self.columns,
            junctions: &mut self.junctions,
            neighbors: &mut self.neighbors,
            blocks: &mut self.blocks,
        };
        (PoseGraph::new(&mut self.nodes, &mut self.loops), work)
    }
}

/// Odometry of a drive: the truth with noise on each step, and a scale that creeps.
fn drift(n: u32, noise_scale: f64) -> Vec<Similarity> {
    let mut rng = Rng::new(5, 0, 0);
    let mut odometry = std::vec![truth(0)];
    for k in 1..n {
        let mut off = noise(&mut rng, [1e-3, 0.02, 1e-3].map(|s| s * noise_scale));
        off[6] += 1e-3 * noise_scale;
        let last = odometry[odometry.len() - 1];
        odometry.push(last * (truth(k - 1).inverse() * truth(k)) * sim3::exp(&off));
    }
    odometry
}

fn measured(odometry: &[Similarity], from: u32, to: u32, lie: f64) -> LoopMeasurement {
    let place = |id: u32| Place { keyframe_id: id, odometry_from_keyframe: odometry[id as usize] };
    let off = sim3::exp(&Tangent7::from([0.0, 0.0, 0.0, lie, 0.0, 0.0, 0.0]));
    LoopMeasurement {
        from: place(from),
        to: place(to),
        from_from_to: truth(from).inverse() * truth(to) * off,
        information: information_of_sigmas(2e-3, 0.02, 2e-3),
    }
}

fn drive(graph: &mut PoseGraph<'_>, odometry: &[Similarity], loops: &[(u32, u32)]) {
    for (k, odometry_from_node) in odometry.iter().enumerate() {
        graph.push_node(k as u32, odometry_from_node, &step_information()).expect("room for a node");
    }
    for &(from, to) in loops {
        graph.push_loop(&measured(odometry, from, to, 0.0)).expect("room for a loop");
    }
}

fn error_m(graph: &PoseGraph<'_>) -> f64 {
    let off = |k: usize| {
        let origin = Point3::origin();
        let id = graph.keyframe_id(k).expect("a node");
        (graph.world_from_node(k).expect("a node") * origin - truth(id) * origin).norm_squared()
    };
    ((0..graph.n_nodes()).map(off).sum::<f64>() / graph.n_nodes() as f64).sqrt()
}

const LOOPS: [(u32, u32); 7] = [(70, 10), (5, 65), (80, 20), (100, 40), (130, 70), (150, 30), (179, 59)];

#[test]
fn derivatives_agree_with_differences() {
    let mut rng = Rng::new(1, 0, 0);
    for size in [0.0, 1e-6, 0.05, 0.5] {
        let [i, j, off] = [(); 3].map(|()| noise(&mut rng, [0.5, 2.0, 0.3]));
        let (i, j) = (sim3::exp(&i), sim3::exp(&j));
        let measured = sim3::exp(&(off * size)) * (j.inverse() * i);
        for is_scale_free in [true, false] {
            let edge = Linearized::new(&measured, &i, &j, is_scale_free);
            for k in 0..7 {
                let mut d = Tangent7::zeros();
                d[k] = if k == 6 && !is_scale_free { 0.0 } else { 1e-5 };
                let (plus, minus) = (sim3::exp(&d), sim3::exp(&-d));
                let by_i = (residual(&measured, &(i * plus), &j) - residual(&measured, &(i * minus), &j)) / 2e-5;
                let by_j = (residual(&measured, &i, &(j * plus)) - residual(&measured, &i, &(j * minus))) / 2e-5;
                assert!((by_i - edge.by_i.column(k)).norm() < 1e-6, "i {k} at {size}: {by_i}");
                assert!((by_j - edge.by_j.column(k)).norm() < 1e-6, "j {k} at {size}: {by_j}");
            }
        }
    }
}

#[test]
fn drift_is_taken_back() {
    let check = |noise_scale: f64, loops: &[(u32, u32)], share: f64| {
        let mut memory = Memory::new(180, 8, 64);
        let (mut graph, mut work) = memory.split();
        let odometry = drift(180, noise_scale);
        drive(&mut graph, &odometry, loops);
        let before = error_m(&graph);
        let report = graph.optimize(&SETTINGS, &mut work).expect("enough memory");
        let after = error_m(&graph);
        assert!(after <= share * before && report.cost_after <= report.cost_before, "{before} -> {after} {report:?}");
        assert!(report.n_iterations < 12 && report.n_rejected == 0, "{report:?}");
        assert_eq!(graph.world_from_node(0), Some(truth(0)));
    };
    check(0.0, &LOOPS, 1.0);
    check(1.0, &LOOPS, 0.25);
    check(2.0, &LOOPS, 0.25);
    check(1.0, &LOOPS[..1], 0.8);
    check(1.0, &[(0, 179)], 0.8);
    check(1.0, &[(0, 60), (1, 61), (2, 62), (3, 63), (61, 62)], 0.8);
    check(1.0, &[], 1.0);
}

#[test]
fn the_optimum_is_one() {
    let mut memory = Memory::new(180, 8, 64);
    let (mut graph, mut work) = memory.split();
    drive(&mut graph, &drift(180, 1.0), &LOOPS);
    let first = graph.optimize(&SETTINGS, &mut work).expect("enough memory");
    // From anywhere near, the same cost: one step of a wrong factor would not get there.
    let mut rng = Rng::new(3, 0, 0);
    for node in graph.nodes.iter_mut().skip(1) {
        node.world_from_node *= sim3::exp(&noise(&mut rng, [0.01, 0.3, 0.01]));
    }
    let again = graph.optimize(&SETTINGS, &mut work).expect("enough memory");
    assert!(again.cost_before > 100.0 * first.cost_after, "{again:?}");
    assert!((again.cost_after / first.cost_after - 1.0).abs() < 1e-4, "{first:?} {again:?}");
    assert!(again.n_iterations < 10, "{again:?}");
}

#[test]
fn the_same_graph_gives_the_same_bits() {
    let run = || {
        let mut memory = Memory::new(180, 8, 64);
        let (mut graph, mut work) = memory.split();
        drive(&mut graph, &drift(180, 2.0), &LOOPS);
        graph.optimize(&SETTINGS, &mut work).expect("enough memory");
        (0..180).map(|k| graph.world_from_node(k)).collect::<Vec<_>>()
    };
    assert_eq!(run(), run());
}

#[test]
fn lies_among_true_loops_are_told() {
    let check = |lies: &[(u32, u32)], n_true_lost: usize| {
        let mut memory = Memory::new(180, 16, 256);
        let (mut graph, mut work) = memory.split();
        let odometry = drift(180, 1.0);
        drive(&mut graph, &odometry, &LOOPS);
        for &(from, to) in lies {
            graph.push_loop(&measured(&odometry, from, to, 25.0)).expect("room");
        }
        let report = graph.optimize(&SETTINGS, &mut work).expect("enough memory");
        let rejected: Vec<bool> = graph.loops().map(|l| l.is_rejected).collect();
        let (of_true, of_lies) = rejected.split_at(LOOPS.len());
        assert!(of_lies.iter().all(|&r| r), "{rejected:?}");
        assert!(of_true.iter().filter(|&&r| r).count() <= n_true_lost, "{rejected:?}");
        assert!(error_m(&graph) < 0.6, "{} {report:?}", error_m(&graph));
    };
    check(&[(90, 30)], 0);
    check(&[(90, 30), (110, 50)], 0);

    check(&[(90, 30), (20, 140), (110, 50)], 0);
}

#[test]
fn what_the_gauge_holds_stays() {
    let check = |gauge: Gauge, held: usize| {
        let mut memory = Memory::new(180, 8, 64);
        let (mut graph, mut work) = memory.split();
        drive(&mut graph, &drift(180, 1.0), &LOOPS);
        let before = graph.world_from_node(held).expect("a node");
        graph.optimize(&OptimizeSettings { gauge, ..SETTINGS }, &mut work).expect("enough memory");
        let moved = sim3::log(&(before.inverse() * graph.world_from_node(held).expect("a node")));
        assert!(moved.norm() < 1e-9, "{gauge:?}: {moved}");
        let other = sim3::log(&(drift(180, 1.0)[90].inverse() * graph.world_from_node(90).expect("a node")));
        assert!(other.norm() > 0.1);
    };
    check(Gauge::First, 0);
    check(Gauge::Newest, 179);
    check(Gauge::Keyframe(33), 33);
}

#[test]
fn scales_stay_when_they_are_not_free() {
    let mut memory = Memory::new(180, 8, 64);
    let (mut graph, mut work) = memory.split();
    let odometry = drift(180, 1.0);
    drive(&mut graph, &odometry, &LOOPS);
    let settings = OptimizeSettings { is_scale_free: false, max_loop_sigmas: 1e3, ..SETTINGS };
    let report = graph.optimize(&settings, &mut work).expect("enough memory");
    assert!(report.cost_after < 0.5 * report.cost_before);
    let off = |k: usize| (graph.world_from_node(k).expect("a node").scaling() / odometry[k].scaling() - 1.0).abs();
    assert!((0..180).all(|k| off(k) < 1e-9));
}

#[test]
fn only_what_a_new_loop_covers_is_optimised() {
    let mut memory = Memory::new(180, 8, 64);
    let (mut graph, mut work) = memory.split();
    let odometry = drift(180, 1.0);
    drive(&mut graph, &odometry, &[(62, 2), (70, 10)]);
    let changed = OptimizeSettings { extent: Extent::Changed, ..SETTINGS };
    let first = graph.optimize(&changed, &mut work).expect("enough memory");
    assert_eq!(first.n_optimized, 68);
    graph.push_loop(&measured(&odometry, 175, 115, 0.0)).expect("room");
    let second = graph.optimize(&changed, &mut work).expect("enough memory");
    assert_eq!(second.n_optimized, 60);
    let third = graph.optimize(&changed, &mut work).expect("enough memory");
    assert_eq!((third.n_optimized, third.n_iterations), (0, 0));
    // It is the optimum of the whole.
    let apart = error_m(&graph);
    let whole = graph.optimize(&SETTINGS, &mut work).expect("enough memory");
    assert!(whole.cost_before - whole.cost_after < 1e-3 * whole.cost_after, "{whole:?}");
    assert!((error_m(&graph) - apart).abs() < 0.01 && whole.n_optimized == 128);
}

#[test]
fn a_full_skeleton_is_thinned_and_keeps_its_loops() {
    let mut memory = Memory::new(64, 8, 64);
    let (mut graph, mut work) = memory.split();
    let odometry = drift(180, 1.0);
    for k in 0..180 {
        graph.push_node(k, &odometry[k as usize], &step_information()).expect("room is made");
        if let Some(&(from, to)) = LOOPS.iter().find(|&&(from, to)| from.max(to) == k) {
            graph.push_loop(&measured(&odometry, from, to, 0.0)).expect("room");
        }
    }
    assert!(graph.n_nodes() <= 64 && graph.keyframe_id(0) == Some(0));
    assert_eq!(graph.keyframe_id(graph.n_nodes() - 1), Some(179));
    // The oldest gaps are not wider than the rest of the thinned part.
    let gaps: Vec<u32> = (1..graph.n_nodes()).map(|k| graph.gap_before(k)).collect();
    assert!(gaps.iter().all(|&g| g <= 8), "{gaps:?}");
    graph.optimize(&SETTINGS, &mut work).expect("enough memory");
    let thinned = error_m(&graph);
    let mut all = Memory::new(180, 8, 64);
    let (mut full, mut work) = all.split();
    drive(&mut full, &odometry, &LOOPS);
    full.optimize(&SETTINGS, &mut work).expect("enough memory");
    assert!(thinned < 2.0 * error_m(&full) + 0.05, "{thinned} {}", error_m(&full));
    // Keyframes that are not in the skeleton stand where the full graph puts them.
    for k in 0..180u32 {
        let place = Place { keyframe_id: k, odometry_from_keyframe: odometry[k as usize] };
        let by_thinned = graph.world_from_keyframe(&place).expect("nodes");
        let off = by_thinned * Point3::origin() - full.world_from_node(k as usize).expect("a node") * Point3::origin();
        assert!(off.norm() < 0.3, "{k}: {off}");
    }
}

impl PoseGraph<'_> {
    fn gap_before(&self, node: usize) -> u32 {
        self.nodes[node].keyframe_id - self.nodes[node - 1].keyframe_id
    }
}

#[test]
fn a_composed_edge_weighs_what_its_parts_do() {
    // Thinning a chain without loops leaves nothing to optimise; with one it must not shift the optimum much, which the
    // test above looks at. Here: two equal steps straight ahead have twice the covariance, and the turn's lever arm.
    let mut memory = Memory::new(3, 1, 1);
    let (mut graph, _) = memory.split();
    for k in 0..4 {
        let ahead = sim3::exp(&Tangent7::from([0.0, 0.0, 0.0, 0.0, 0.0, f64::from(k), 0.0]));
        graph.push_node(k, &ahead, &information_of_sigmas(0.1, 0.5, 0.2)).expect("room is made");
    }
    assert_eq!((graph.keyframe_id(1), graph.keyframe_id(2)), (Some(2), Some(3)));
    let covariance = graph.nodes[1].information.try_inverse().expect("invertible");
    let expected = [0.02, 0.02, 0.02, 0.5 + 0.01, 0.5 + 0.01, 0.5 + 0.04, 0.08];
    for (k, expected) in expected.into_iter().enumerate() {
        assert!((covariance[(k, k)] - expected).abs() < 1e-9, "{covariance}");
    }
}

#[test]
fn keyframes_between_nodes_blend() {
    let mut memory = Memory::new(2, 1, 1);
    let (mut graph, _) = memory.split();
    let at = |x: f64| sim3::exp(&Tangent7::from([0.0, 0.0, 0.0, x, 0.0, 0.0, 0.0]));
    assert!(graph.world_from_keyframe(&Place { keyframe_id: 0, odometry_from_keyframe: at(0.0) }).is_none());
    graph.push_node(10, &at(0.0), &step_information()).expect("room");
    graph.push_node(20, &at(10.0), &step_information()).expect("room");
    graph.nodes[1].world_from_node = at(12.0);
    for (id, x, expected) in [(10, 0.0, 0.0), (15, 5.0, 6.0), (20, 10.0, 12.0), (25, 15.0, 17.0), (5, -5.0, -5.0)] {
        let place = Place { keyframe_id: id, odometry_from_keyframe: at(x) };
        let found = graph.world_from_keyframe(&place).expect("nodes") * Point3::origin();
        assert!((found.x - expected).abs() < 1e-12, "{id}: {found}");
    }
}

#[test]
fn what_does_not_fit_is_a_value() {
    let mut memory = Memory::new(180, 8, 2);
    let (mut graph, mut work) = memory.split();
    let odometry = drift(180, 1.0);
    drive(&mut graph, &odometry, &LOOPS);
    let error = graph.optimize(&SETTINGS, &mut work).expect_err("2 blocks are too few");
    assert_eq!(error.what, SolverSlice::Blocks);
    assert!(error.needed > 2 && std::format!("{error}").contains("factor blocks"));
    work.columns = &mut [];
    let error = graph.optimize(&SETTINGS, &mut work).expect_err("no columns");
    assert_eq!(error, SolverFull { what: SolverSlice::Columns, needed: 180 });

    graph.push_loop(&measured(&odometry, 90, 30, 0.0)).expect("the eighth");
    let full = graph.push_loop(&measured(&odometry, 91, 31, 0.0));
    assert_eq!(full, Err(PushProblem::Full { capacity: 8 }));
    graph.pop_loop();
    let same = graph.push_loop(&measured(&odometry, 90, 90, 0.0));
    assert_eq!(same, Err(PushProblem::SameNode { keyframe_id: 90 }));
    let mut broken = measured(&odometry, 90, 30, 0.0);
    broken.information[(3, 3)] = f64::NAN;
    assert_eq!(graph.push_loop(&broken), Err(PushProblem::NotFinite));
    let broken = measured(&odometry, 90, 30, f64::NAN);
    assert_eq!(graph.push_loop(&broken), Err(PushProblem::NotFinite));
    let late = graph.push_node(179, &truth(0), &step_information());
    assert_eq!(late, Err(PushProblem::OutOfOrder { last: 179 }));
    let (mut empty, _) = (PoseGraph::new(&mut [], &mut []), ());
    assert_eq!(empty.push_node(0, &truth(0), &step_information()), Err(PushProblem::Full { capacity: 0 }));
    assert_eq!(empty.push_loop(&measured(&odometry, 90, 30, 0.0)), Err(PushProblem::NoNodes));
    assert!(empty.optimize(&SETTINGS, &mut work).is_ok_and(|r| r.n_optimized == 0));
}
