//! What closing loops makes of a trajectory whose truth is known.

use crate::drive::{Frame, Keyframe, Tracked, keyframes};
use crate::error::PlacesError;
use crate::frames::Frames;
use crate::measure::true_poses;
use kilogs_camera::source::PlaybackRange;
use kilogs_core::conventions::{Rigid, Similarity};
use kilogs_core::features::{Feature, FeatureMatch, Nearest, SimdLevel};
use kilogs_core::loop_closure::{
    AlignmentLimits, JudgedCandidate, KeptPlace, KeyframePacket, LoopCapacities, LoopCloser, LoopDecision,
    LoopSettings, LoopStorage, MapAlignment, OdometryNoise, PointsInMemory,
};
use kilogs_core::places::{
    LoopScratch, PlaceSlot, PlaceStorage, PlaceView, PointDepth, Posting, Tally, Vocabulary, WORDS_PER_PLACE,
};
use kilogs_core::pose::{Match, PointMatch};
use kilogs_core::pose_graph::{Column, FactorBlock, GraphCapacities, Junction, LoopEdge, Node, Place, SolverStorage};
use kilogs_eval::align::Freedom;
use kilogs_eval::associate::by_time;
use kilogs_eval::ate::ate;
use kilogs_eval::trajectory::StampedPose;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Options of `close`.
#[derive(Debug, clap::Args)]
pub(crate) struct CloseArgs {
    /// Folder of a recording with `poses.txt`.
    folder: PathBuf,
    /// Vocabulary file.
    #[arg(long)]
    vocabulary: PathBuf,
    /// Frames that are left out at the beginning.
    #[arg(long, default_value_t = 0)]
    start: u64,
    /// Frames at most.
    #[arg(long)]
    frames: Option<u64>,
    /// Features of a keyframe that become words.
    #[arg(long, default_value_t = 1024)]
    features: usize,
    /// Described points of a keyframe that are kept; every point is described twice.
    #[arg(long, default_value_t = 1024)]
    points: usize,
    /// Keyframes that can be recognized.
    #[arg(long, default_value_t = 4096)]
    places: usize,
}

const GRAPH: GraphCapacities = GraphCapacities { nodes: 8192, loops: 512, blocks: 8192 };

/// Tracks the recording, closes its loops, and prints both trajectories' errors.
pub(crate) fn run(args: &CloseArgs) -> Result<(), PlacesError> {
    let range = PlaybackRange { start: args.start, frames: args.frames, passes: 1 };
    let truth = true_poses(&args.folder)?;
    let frames = Frames::of_folder(&args.folder, &range)?;
    let tracked = keyframes(frames, args.start, args.features, args.points)?;
    let path = &args.vocabulary;
    let bytes =
        std::fs::read(path).map_err(|source| PlacesError::File { what: "reading", path: path.clone(), source })?;
    let vocabulary =
        Vocabulary::open(bytes.leak()).map_err(|problem| PlacesError::Vocabulary { path: path.clone(), problem })?;
    let (places, features, points) = (args.places, args.features, args.points);
    let capacities = LoopCapacities { places, words: vocabulary.n_words(), features, points, graph: GRAPH };
    println!(
        "{}: {} frames, {} keyframes, {:.1} MB",
        args.folder.display(),
        tracked.frames.len(),
        tracked.keyframes.len(),
        (capacities.bytes() + PointsInMemory::bytes(places, points)) as f64 * 1e-6
    );
    let mut corrected = Vec::new();
    with_storage(&capacities, |storage| {
        let settings = LoopSettings::STANDARD;
        let simd = SimdLevel::new();
        let mut closer = LoopCloser::new(simd, tracked.camera, vocabulary, settings, &capacities, storage)?;
        drive(&mut closer, &tracked, &truth)?;
        corrected = correct(&closer, &tracked);
        Ok::<_, PlacesError>(())
    })?;
    // Keyframes know their place in the whole recording, poses only follow each other.
    let truth = truth.get(args.start as usize..).unwrap_or(&[]);
    let by_odometry: Vec<_> = tracked.frames.iter().map(|frame| frame.odometry_from_camera).collect();
    print_errors("without loops", &tracked.frames, &by_odometry, truth);
    print_errors("with loops", &tracked.frames, &corrected, truth);
    Ok(())
}

/// Feeds the closer keyframe by keyframe, and prints what it decided.
fn drive(closer: &mut LoopCloser<'_>, tracked: &Tracked, truth: &[Rigid]) -> Result<(), PlacesError> {
    let mut counts = BTreeMap::<String, u32>::new();
    let mut alignment = MapAlignment::new(Similarity::identity(), AlignmentLimits::STANDARD);
    let mut frames = tracked.frames.iter().peekable();
    for (i, keyframe) in tracked.keyframes.iter().enumerate() {
        let before = i.checked_sub(1).map_or(keyframe, |before| &tracked.keyframes[before]);
        let outcome = closer.observe(&packet(i, keyframe, before))?;
        for judged in &outcome.candidates {
            *counts.entry(name(judged)).or_default() += 1;
            if judged.added_cost.is_finite() {
                let old = tracked.keyframes[judged.candidate.ordinal as usize].frame as usize;
                let at = |frame: usize| truth.get(frame).map_or([f64::NAN; 3], |t| t.translation.vector.into());
                let away = nalgebra::Vector3::from(at(keyframe.frame as usize)) - nalgebra::Vector3::from(at(old));
                println!(
                    "  frame {} saw {old}, truly {:.1} m away: {}, {} inliers, scale {:.4}, residual {:.1}, added {:.1}",
                    keyframe.frame,
                    away.norm(),
                    name(judged),
                    judged.evidence.map_or(0, |e| e.n_inliers),
                    judged.evidence.map_or(f64::NAN, |e| e.scale),
                    judged.squared_sigmas,
                    judged.added_cost
                );
            }
        }
        while let Some(frame) = frames.next_if(|frame| frame.keyframe <= Some(i)) {
            alignment.follow(&closer.map_from_odometry(), &frame.odometry_from_camera);
        }
    }
    println!("  candidates: {counts:?}");
    let left = alignment.map_from_odometry().inverse() * closer.map_from_odometry();
    println!(
        "  map_from_odometry: {:.4} of the scale and {:.3} rad behind at the end",
        left.scaling(),
        left.isometry.rotation.angle()
    );
    Ok(())
}

fn name(judged: &JudgedCandidate) -> String {
    match (judged.decision, judged.evidence) {
        (LoopDecision::NotVerified, Some(evidence)) => format!("{:?}", evidence.verdict),
        (decision, _) => format!("{decision:?}"),
    }
}

fn packet<'k>(ordinal: usize, keyframe: &'k Keyframe, before: &Keyframe) -> KeyframePacket<'k> {
    let step = before.odometry_from_camera.inverse() * keyframe.odometry_from_camera;
    KeyframePacket {
        ordinal: ordinal as u32,
        odometry_from_camera: keyframe.odometry_from_camera,
        information: OdometryNoise::STANDARD.information(step.translation.vector.norm()),
        features: &keyframe.features,
        points: PlaceView { features: &keyframe.points, depths: &keyframe.depths },
    }
}

/// All frames, each moved with its keyframe.
fn correct(closer: &LoopCloser<'_>, tracked: &Tracked) -> Vec<Rigid> {
    let map_from_odometry = |keyframe: usize| {
        let odometry = Similarity::from_isometry(tracked.keyframes[keyframe].odometry_from_camera, 1.0);
        let place = Place { keyframe_id: keyframe as u32, odometry_from_keyframe: odometry };
        closer.world_from_keyframe(&place).map(|world| world * odometry.inverse())
    };
    let moved = |frame: &Frame| {
        let map = frame.keyframe.and_then(map_from_odometry).unwrap_or_else(Similarity::identity);
        (map * Similarity::from_isometry(frame.odometry_from_camera, 1.0)).isometry
    };
    tracked.frames.iter().map(moved).collect()
}

fn print_errors(what: &str, frames: &[Frame], poses: &[Rigid], truth: &[Rigid]) {
    let stamped = |poses: &[Rigid]| -> Vec<_> {
        let pairs = frames.iter().zip(poses);
        pairs.map(|(frame, &pose)| StampedPose { time_s: frame.time_s, world_from_camera: pose }).collect()
    };
    let pairs = by_time(&stamped(poses), &stamped(truth));
    let [similar, rigid] = [Freedom::Sim3, Freedom::Se3].map(|freedom| ate(&pairs, freedom));
    println!(
        "  {what}: ATE Sim(3) {:.3} m, SE(3) {:.3} m, scale {:.4}",
        similar.as_ref().map_or(f64::NAN, |a| a.rmse_m),
        rigid.as_ref().map_or(f64::NAN, |a| a.rmse_m),
        similar.as_ref().map_or(f64::NAN, |a| a.alignment.scale)
    );
}

/// Takes the memory that the capacities say.
fn with_storage<T>(capacities: &LoopCapacities, then: impl FnOnce(LoopStorage<'_>) -> T) -> T {
    let LoopCapacities { places, words, features, points, graph } = *capacities;
    then(LoopStorage {
        index: PlaceStorage {
            slots: &mut vec![PlaceSlot::UNUSED; places],
            postings: &mut vec![Posting::UNUSED; places * WORDS_PER_PLACE],
            first_of_word: &mut vec![0; words],
        },
        kept: &mut vec![KeptPlace::default(); places],
        points: &mut PointsInMemory {
            features: &mut vec![Feature::NONE; places * points],
            depths: &mut vec![PointDepth::default(); places * points],
            n_points: &mut vec![0; places],
            points_per_place: points,
        },
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
    })
}
