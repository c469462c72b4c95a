//! Rounds of a circle that look the same every time, with an odometry whose scale creeps.

use super::*;
use crate::camera::Pinhole;
use crate::conventions::{Rigid, Similarity};
use crate::features::{Descriptor, Feature, FeatureMatch, Nearest, SimdLevel};
use crate::math::Rng;
use crate::math::sim3::{self, Matrix7, Tangent7};
use crate::places::{
    Below, LoopScratch, PlaceSlot, PlaceStorage, PlaceView, PointDepth, Posting, Signature, Tally, Vocabulary,
    VocabularyNode, WORDS_PER_PLACE, Word, encode_vocabulary, vocabulary_bytes,
};
use crate::pose::{Match, PointMatch};
use crate::pose_graph::{Column, FactorBlock, GraphCapacities, Junction, LoopEdge, Node, Place, SolverStorage};
use nalgebra::{Matrix6, Point3, Translation3, UnitQuaternion, Vector3, Vector6};
use std::vec;
use std::vec::Vec;

const CAMERA: Pinhole = Pinhole { width: 1241, height: 376, fx: 718.0, fy: 718.0, cx: 607.0, cy: 185.0 };
const ROUND: u32 = 60;
const N_WORDS: usize = 900;
const CAPACITIES: LoopCapacities = LoopCapacities {
    places: 90,
    words: N_WORDS,
    features: 120,
    points: 120,
    graph: GraphCapacities { nodes: 128, loops: 16, blocks: 64 },
};
/// What the scale loses from keyframe to keyframe.
const CREEP: f64 = 1e-3;

fn descriptor(rng: &mut Rng) -> Descriptor {
    Descriptor([(); 4].map(|()| u64::from(rng.next_u32()) << 32 | u64::from(rng.next_u32())))
}

/// A flat tree of strangers.
fn vocabulary() -> Vec<u8> {
    let mut rng = Rng::new(9, 0, 0);
    let mut nodes =
        vec![VocabularyNode { median: Descriptor([0; 4]), below: Below::Children { first: 1, n: N_WORDS as u16 } }];
    let word = |word: usize| Below::Word { word: word as Word, rarity: 4096 };
    nodes.extend((0..N_WORDS).map(|i| VocabularyNode { median: descriptor(&mut rng), below: word(i) }));
    let mut bytes = vec![0; vocabulary_bytes(nodes.len())];
    encode_vocabulary(&nodes, &mut bytes).expect("as long as it has to be");
    bytes
}

fn truth(keyframe: u32) -> Rigid {
    let turn = f64::from(keyframe) * std::f64::consts::TAU / f64::from(ROUND);
    let radius_m = 30.0;
    let place = Translation3::new(radius_m * (1.0 - turn.cos()), 0.0, radius_m * turn.sin());
    Rigid::from_parts(place, UnitQuaternion::from_scaled_axis(Vector3::new(0.0, turn, 0.0)))
}

/// Truth with lengths that shrink on the way.
fn odometry(n: u32) -> Vec<Rigid> {
    let mut poses = vec![truth(0)];
    for k in 1..n {
        let mut step = truth(k - 1).inverse() * truth(k);
        step.translation.vector *= scale_at(k);
        poses.push(poses[poses.len() - 1] * step);
    }
    poses
}

fn scale_at(keyframe: u32) -> f64 {
    (1.0 - CREEP).powi(keyframe as i32)
}

/// What a keyframe sees: the points of the place that it `shows`, in its odometry's metres.
fn look(keyframe: u32, shows: u32) -> (Vec<Feature>, Vec<PointDepth>) {
    let mut rng = Rng::new(2, u64::from(shows % ROUND), 0);
    let aside = if shows >= ROUND { Point3::new(0.3, 0.0, -0.4) } else { Point3::origin() };
    let (mut features, mut depths) = (Vec::new(), Vec::new());
    for i in 0..CAPACITIES.points {
        let look = descriptor(&mut rng);
        let mut within = |half: f64| half * (2.0 * rng.unit_f64() - 1.0);
        let (x, y, z) = (within(0.6), within(0.2), 20.0 + within(12.0));
        let point = Point3::new(x * z, y * z, z) - aside.coords;
        let Some(pixel) = CAMERA.project(&point.coords) else { continue };
        let pixel = [pixel.x as f32, pixel.y as f32];
        features.push(Feature {
            pixel,
            scale: 2.0,
            descriptor: look,
            min_eigenvalue: 200.0 - i as f32,
            ..Feature::NONE
        });
        depths.push(PointDepth { depth_m: (point.z * scale_at(keyframe)) as f32, relative_sigma: 0.03 });
    }
    (features, depths)
}

/// Calls `then` with a closer of these capacities.
fn with_closer<T>(capacities: LoopCapacities, then: impl FnOnce(&mut LoopCloser<'_>) -> T) -> T {
    let bytes = vocabulary();
    let LoopCapacities { places, words, features, points, graph } = capacities;
    let mut kept_points = PointsInMemory {
        features: &mut vec![Feature::NONE; places * points],
        depths: &mut vec![PointDepth::default(); places * points],
        n_points: &mut vec![0; places],
        points_per_place: points,
    };
    let storage = LoopStorage {
        index: PlaceStorage {
            slots: &mut vec![PlaceSlot::UNUSED; places],
            postings: &mut vec![Posting::UNUSED; places * WORDS_PER_PLACE],
            first_of_word: &mut vec![0; words],
        },
        kept: &mut vec![KeptPlace::default(); places],
        points: &mut kept_points,
        tally: &mut vec![Tally::default(); features],
        scratch: LoopScratch {
            nearest: &mut vec![Nearest::NONE; 2 * points],
            pairs: &mut vec![FeatureMatch::default(); points],
            matches: &mut vec![Match::default(); points],
            point_matches: &mut vec![PointMatch::default(); points],
            is_inlier: &mut vec![false; points],
        },
        nodes: &mut vec![Node::default(); graph.nodes],
        loops: &mut vec![LoopEdge::default(); graph.loops],
        solver: SolverStorage {
            columns: &mut vec![Column::default(); graph.nodes],
            junctions: &mut vec![Junction::default(); graph.junctions()],
            neighbors: &mut vec![u64::MAX; graph.neighbor_words()],
            blocks: &mut vec![FactorBlock::default(); graph.blocks],
        },
    };
    let vocabulary = Vocabulary::open(&bytes).expect("a vocabulary");
    let (simd, settings) = (SimdLevel::new(), LoopSettings::STANDARD);
    then(&mut LoopCloser::new(simd, CAMERA, vocabulary, settings, &capacities, storage).expect("enough memory"))
}

/// Shows a keyframe to the closer.
fn observe(
    closer: &mut LoopCloser<'_>,
    (k, (features, depths)): (u32, (Vec<Feature>, Vec<PointDepth>)),
    odometry_from_camera: Rigid,
    information: Matrix7,
) -> Vec<(u32, JudgedCandidate)> {
    let points = PlaceView { features: &features, depths: &depths };
    let packet = KeyframePacket { ordinal: k, odometry_from_camera, information, features: &features, points };
    let outcome = closer.observe(&packet).expect("room");
    outcome.candidates.into_iter().map(|judged| (k, judged)).collect()
}

/// Closes the loops of a drive; `shows` says which place each keyframe looks like.
fn drive(n: u32, shows: impl Fn(u32) -> u32, capacities: LoopCapacities) -> (Vec<(u32, JudgedCandidate)>, f64, f64) {
    drive_by(&odometry(n), |_| OdometryNoise::STANDARD.information(3.0), shows, capacities)
}

/// The same with an odometry, and what is known of the step to each keyframe.
fn drive_by(
    odometry: &[Rigid],
    information: impl Fn(u32) -> Matrix7,
    shows: impl Fn(u32) -> u32,
    capacities: LoopCapacities,
) -> (Vec<(u32, JudgedCandidate)>, f64, f64) {
    let n = odometry.len() as u32;
    with_closer(capacities, |closer| {
        let mut judged = Vec::new();
        for (k, odometry_from_camera) in (0..n).zip(odometry) {
            judged.extend(observe(closer, (k, look(k, shows(k))), *odometry_from_camera, information(k)));
        }
        let off = |k: u32| {
            let odometry_from_keyframe = Similarity::from_isometry(odometry[k as usize], 1.0);
            let place = Place { keyframe_id: k, odometry_from_keyframe };
            let corrected = closer.world_from_keyframe(&place).expect("keyframes").isometry.translation.vector;
            let true_place = truth(k).translation.vector;
            [(odometry[k as usize].translation.vector - true_place).norm(), (corrected - true_place).norm()]
        };
        let worst = |which: usize| (0..n).map(|k| off(k)[which]).fold(0.0, f64::max);
        (judged, worst(0), worst(1))
    })
}

/// A round that is known from an earlier drive, and a drive of ten keyframes that begins where `from` was without knowing it:
/// the candidates, and how far off the last keyframe is.
fn resume(from: u32) -> (Vec<(u32, JudgedCandidate)>, f64) {
    with_closer(CAPACITIES, |closer| {
        let mut words = Vec::new();
        let bytes = vocabulary();
        let vocabulary = Vocabulary::open(&bytes).expect("a vocabulary");
        for k in 0..ROUND {
            let (features, depths) = look(0, k);
            let signature = Signature::of(&vocabulary, &features, &mut vec![Tally::default(); features.len()]);
            let view = PlaceView { features: &features, depths: &depths };
            closer.kept_points().keep(k as usize, k, &signature, &view);
            words.push(signature);
        }
        for (k, words) in (0..ROUND).zip(&words) {
            let place = Place { keyframe_id: k, odometry_from_keyframe: Similarity::from_isometry(truth(k), 1.0) };
            let information = OdometryNoise::STANDARD.information(3.0);
            closer.recall(k as usize, &place, words, &information).expect("room");
        }
        let mut judged = Vec::new();
        // The later drive keeps a little aside, as `look` does.
        let later = |k: u32| truth(k) * Translation3::new(0.3, 0.0, -0.4);
        let start = later(from).inverse();
        for k in from..from + 10 {
            let information =
                if k == from { OdometryNoise::unknown_start() } else { OdometryNoise::STANDARD.information(3.0) };
            judged.extend(observe(closer, (ROUND + k, look(0, ROUND + k)), start * later(k), information));
        }
        let last = Similarity::from_isometry(start * later(from + 9), 1.0);
        let found = (closer.map_from_odometry() * last).isometry.translation.vector;
        (judged, (found - later(from + 9).translation.vector).norm())
    })
}

fn count(judged: &[(u32, JudgedCandidate)], is_counted: impl Fn(LoopDecision) -> bool) -> usize {
    judged.iter().filter(|(_, judged)| is_counted(judged.decision)).count()
}

#[test]
fn a_second_round_is_closed_and_the_drift_taken_back() {
    let (judged, before_m, after_m) = drive(90, |k| k, CAPACITIES);
    let accepted: Vec<_> = judged.iter().filter(|(_, j)| j.decision == LoopDecision::Accepted).collect();
    assert!(accepted.len() >= 8, "{} candidates", judged.len());
    for (k, judged) in accepted {
        assert_eq!(judged.candidate.ordinal, k - ROUND);
        let scale = judged.evidence.expect("measured").scale;
        assert!((scale * scale_at(*k) / scale_at(k - ROUND) - 1.0).abs() < 5e-3, "{scale}");
    }
    assert!(before_m > 2.0 && after_m < 0.3 * before_m, "{before_m} m before, {after_m} m after");
    assert!(count(&judged, |d| d == LoopDecision::TooSoon) > 8);
}

#[test]
fn a_place_that_only_looks_the_same_moves_nothing() {
    // Keyframes 75 to 80 stand where 15 to 20 do and look like another stretch of the circle.
    let (judged, before_m, after_m) =
        drive(82, |k| if (75..=80).contains(&k) { k - 40 - ROUND / 2 } else { 1000 + k }, CAPACITIES);
    assert!(
        count(&judged, |d| matches!(d, LoopDecision::TooFarOff | LoopDecision::Contradicted)) >= 2,
        "{} candidates",
        judged.len()
    );
    assert_eq!(count(&judged, |d| d == LoopDecision::Accepted), 0);
    assert!((before_m - after_m).abs() < 1e-9, "{before_m} m before, {after_m} m after");
}

#[test]
fn a_drive_that_was_lost_on_its_way_is_found_in_the_next_known_street() {
    const LOST_AT: u32 = 50;
    let mut lost = odometry(90);
    // It went on as if the way had been another one.
    let guess = Rigid::new(Vector3::new(20.0, 1.0, -35.0), Vector3::new(0.0, 1.2, 0.0));
    for odometry_from_camera in &mut lost[LOST_AT as usize..] {
        *odometry_from_camera = guess * *odometry_from_camera;
    }
    let usual = OdometryNoise::STANDARD.information(3.0);
    let grown = Matrix6::from_diagonal(&Vector6::new(1.0, 1.0, 1.0, 900.0, 900.0, 900.0));
    let blind = OdometryNoise::STANDARD.blind_information(3.0, &grown, 0.05);
    let (judged, before_m, after_m) = drive_by(&lost, |k| if k == LOST_AT { blind } else { usual }, |k| k, CAPACITIES);
    let accepted: Vec<_> = judged.iter().filter(|(_, j)| j.decision == LoopDecision::Accepted).collect();
    let first = accepted.first().expect("it is found").0;
    assert!((ROUND..=ROUND + 2).contains(&first), "keyframe {first} of a street that begins at {ROUND}");
    assert!(accepted.iter().all(|(k, judged)| judged.candidate.ordinal == k - ROUND));
    assert!(before_m > 30.0 && after_m < 2.0, "{before_m} m before, {after_m} m after");
    // A guess that passes for odometry is never found to be wrong.
    let (judged, ..) = drive_by(&lost, |_| usual, |k| k, CAPACITIES);
    assert_eq!(count(&judged, |d| d == LoopDecision::Accepted), 0);
}

#[test]
fn a_drive_that_begins_anywhere_in_a_known_round_is_found_there() {
    let (judged, off_m) = resume(20);
    let accepted: Vec<_> = judged.iter().filter(|(_, j)| j.decision == LoopDecision::Accepted).collect();
    let first = accepted.first().expect("it is found");
    assert_eq!((first.0, first.1.candidate.ordinal), (ROUND + 22, 22), "the third keyframe in a row decides");
    assert!(off_m < 0.3, "{off_m} m off");
}

#[test]
fn full_containers_are_values() {
    let graph = GraphCapacities { loops: 2, ..CAPACITIES.graph };
    let (judged, before_m, after_m) = drive(90, |k| k, LoopCapacities { graph, places: 40, ..CAPACITIES });
    assert_eq!(count(&judged, |d| d == LoopDecision::Accepted), 2, "{} candidates", judged.len());
    assert!(count(&judged, |d| matches!(d, LoopDecision::NotPushed(_))) > 0);
    assert_eq!(count(&judged, |d| d == LoopDecision::Forgotten), 0, "the index knows whose points are kept");
    assert!(after_m < 0.7 * before_m, "{before_m} m before, {after_m} m after");
}

#[test]
fn the_odometry_frame_moves_in_bounded_steps_and_arrives() {
    let check = |wanted: [f64; 7]| {
        let wanted = sim3::exp(&Tangent7::from(wanted));
        let mut alignment = MapAlignment::new(Similarity::identity(), AlignmentLimits::STANDARD);
        for k in 0..2000 {
            let camera = truth(k);
            let before = alignment.map_from_odometry();
            let after = alignment.follow(&wanted, &camera);
            let at = |map: Similarity| map * Similarity::from_isometry(camera, 1.0);
            let (before, after) = (at(before), at(after));
            let moved_m = (after.isometry.translation.vector - before.isometry.translation.vector).norm();
            let limits = AlignmentLimits::STANDARD;
            assert!(moved_m <= 1.01 * limits.translation_m, "{moved_m} m at once");
            assert!(after.isometry.rotation.angle_to(&before.isometry.rotation) <= 1.01 * limits.rotation_rad);
            assert!((after.scaling() / before.scaling()).ln().abs() <= 1.01 * limits.log_scale);
        }
        let left = sim3::log(&(alignment.map_from_odometry().inverse() * wanted));
        assert!(left.norm() < 1e-9, "{left}");
    };
    check([0.0; 7]);
    check([0.0, 0.0, 0.0, 5.0, -1.0, 8.0, 0.0]);
    check([0.02, -0.2, 0.01, -3.0, 0.4, 2.0, 0.05]);
}

#[test]
fn a_slice_that_is_too_short_is_named() {
    let small = LoopStorageTooSmall { what: "kept", found: 3, needed: 4 };
    assert_eq!(std::format!("{small}"), "closing loops needs 4 elements of kept, found 3");
}
