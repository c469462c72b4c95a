//! One keyframe after the other through recognition, verification and the graph.

use super::outcome::{JudgedCandidate, KeyframeOutcome, LoopDecision};
use super::settings::LoopSettings;
use super::storage::{KeptPlaces, LoopCapacities, LoopStorage, LoopStorageTooSmall};
use crate::camera::Pinhole;
use crate::conventions::{Rigid, Similarity};
use crate::features::{Feature, SimdLevel};
use crate::math::Rng;
use crate::math::sim3::{self, Matrix7, Tangent7};
use crate::places::{
    LoopScratch, PlaceCandidate, PlaceIndex, PlaceRecognizer, PlaceView, Signature, Tally, VerifiedLoop, Vocabulary,
    verify_loop,
};
use crate::pose_graph::{
    Extent, LoopMeasurement, LoopVerdict, OptimizeReport, OptimizeSettings, Place, PoseGraph, PushProblem, SolverFull,
    SolverStorage,
};
use heapless::Vec;

/// Seed of the samples that verification draws.
const SEED: u64 = 0;

/// Everything that closing loops needs of a keyframe.
#[derive(Clone, Copy, Debug)]
pub struct KeyframePacket<'a> {
    /// Its number; ascending, with gaps where keyframes were left out.
    pub ordinal: u32,
    /// Where it stands by odometry alone, in one frame for the whole drive.
    pub odometry_from_camera: Rigid,
    /// How well the step since the packet before is known, see [`OdometryNoise`](super::OdometryNoise): little, where
    /// tracking was lost.
    pub information: Matrix7,
    /// Its features: they become words.
    pub features: &'a [Feature],
    /// Its points with depths: they are measured against another view
    /// ([`describe_points`](crate::places::describe_points)).
    pub points: PlaceView<'a>,
}

/// Finds places that were seen before and keeps the map in agreement with them.
#[derive(Debug)]
pub struct LoopCloser<'m> {
    simd: SimdLevel,
    camera: Pinhole,
    vocabulary: Vocabulary<'m>,
    settings: LoopSettings,
    points_per_view: usize,
    recognizer: PlaceRecognizer<'m>,
    kept: KeptPlaces<'m>,
    tally: &'m mut [Tally],
    scratch: LoopScratch<'m>,
    graph: PoseGraph<'m>,
    solver: SolverStorage<'m>,
    newest: Option<Place>,
    /// Keyframe of the loop that was closed last.
    last_closed: Option<u32>,
    /// Of the graph as it was optimised last.
    cost: f64,
}

impl<'m> LoopCloser<'m> {
    /// A closer that has seen nothing.
    ///
    /// # Errors
    /// [`LoopStorageTooSmall`] names the slice that does not hold what `capacities` say.
    pub fn new(
        simd: SimdLevel,
        camera: Pinhole,
        vocabulary: Vocabulary<'m>,
        settings: LoopSettings,
        capacities: &LoopCapacities,
        storage: LoopStorage<'m>,
    ) -> Result<Self, LoopStorageTooSmall> {
        storage.check(capacities)?;
        let kept = KeptPlaces { kept: storage.kept, points: storage.points, n_kept: 0 };
        Ok(Self {
            simd,
            camera,
            vocabulary,
            settings,
            points_per_view: capacities.points,
            recognizer: PlaceRecognizer::new(PlaceIndex::new(storage.index)?, settings.recognizer),
            kept,
            tally: storage.tally,
            scratch: storage.scratch,
            graph: PoseGraph::new(storage.nodes, storage.loops),
            solver: storage.solver,
            newest: None,
            last_closed: None,
            cost: 0.0,
        })
    }

    /// Tracking was lost before the next keyframe: it may show any place of before, and a loop says where it is.
    pub fn note_lost(&mut self, next_ordinal: u32) {
        self.recognizer.begin_anew(next_ordinal);
        self.last_closed = None;
    }

    /// Takes in the next keyframe and closes the loop that it shows, if there is one.
    ///
    /// # Errors
    /// [`PushProblem`]: the keyframe is out of order or not finite, or the graph is full; nothing was changed.
    ///
    /// # Cost
    /// A recognition, at most four verifications, and for a verified loop an optimisation of the graph.
    pub fn observe(&mut self, keyframe: &KeyframePacket<'_>) -> Result<KeyframeOutcome, PushProblem> {
        let odometry_from_keyframe = Similarity::from_isometry(keyframe.odometry_from_camera, 1.0);
        let place = Place { keyframe_id: keyframe.ordinal, odometry_from_keyframe };
        self.graph.push_node(keyframe.ordinal, &odometry_from_keyframe, &keyframe.information)?;
        self.newest = Some(place);
        let view = self.view(&keyframe.points);
        let signature = Signature::of(&self.vocabulary, keyframe.features, self.tally);
        let (candidates, remembered) = self.recognizer.observe(keyframe.ordinal, &signature);
        let mut outcome = KeyframeOutcome { remembered, candidates: Vec::new(), optimized: None };
        for candidate in candidates {
            let mut judged = JudgedCandidate {
                candidate,
                decision: LoopDecision::AnotherAccepted,
                evidence: None,
                squared_sigmas: f64::NAN,
                added_cost: f64::NAN,
            };
            if outcome.optimized.is_none() {
                outcome.optimized = self.judge(&place, &view, &mut judged);
            }
            // As many as candidates.
            let _ = outcome.candidates.push(judged);
        }
        self.kept.keep(&place, &signature, &view, remembered);
        Ok(outcome)
    }

    /// Knows a keyframe of an earlier drive again, before the first of this one: ids ascend. Its points are in `slot` of the
    /// [`PlacePoints`](super::PlacePoints). The first packet of the new drive has an `information` next to none: a loop with
    /// an earlier drive says where it begins.
    ///
    /// # Errors
    /// [`PushProblem`]: the keyframe is out of order or not finite, or the graph is full; nothing was changed.
    pub fn recall(
        &mut self,
        slot: usize,
        place: &Place,
        words: &Signature,
        information: &Matrix7,
    ) -> Result<(), PushProblem> {
        self.graph.push_node(place.keyframe_id, &place.odometry_from_keyframe, information)?;
        let remembered = self.recognizer.recall(place.keyframe_id, words);
        self.kept.recall(slot, place, remembered);
        Ok(())
    }

    /// Where a keyframe stands in the map by now; `place` is where odometry put it. `None` before the first.
    pub fn world_from_keyframe(&self, place: &Place) -> Option<Similarity> {
        self.graph.world_from_keyframe(place)
    }

    /// Where the odometry's frame belongs around the newest keyframe. It jumps when a loop is closed:
    /// [`MapAlignment`](super::MapAlignment) follows it smoothly.
    pub fn map_from_odometry(&self) -> Similarity {
        let corrected =
            |place: &Place| Some(self.graph.world_from_keyframe(place)? * place.odometry_from_keyframe.inverse());
        self.newest.as_ref().and_then(corrected).unwrap_or_else(Similarity::identity)
    }

    /// Where the points of places are kept.
    #[cfg(test)]
    pub(super) fn kept_points(&mut self) -> &mut dyn super::PlacePoints {
        self.kept.points
    }

    /// Keyframes that can be recognized.
    pub fn n_places(&self) -> usize {
        self.kept.n_kept
    }

    /// Keyframes of the skeleton.
    pub fn n_nodes(&self) -> usize {
        self.graph.n_nodes()
    }

    /// The loops that are closed.
    pub fn loops(&self) -> impl Iterator<Item = LoopVerdict> + '_ {
        self.graph.loops()
    }

    /// The points that there is room for.
    fn view<'a>(&self, points: &PlaceView<'a>) -> PlaceView<'a> {
        let n = points.features.len().min(points.depths.len()).min(self.points_per_view);
        PlaceView { features: &points.features[..n], depths: &points.depths[..n] }
    }

    /// Decides about one candidate; the optimisation if it is a loop.
    fn judge(&mut self, place: &Place, view: &PlaceView<'_>, judged: &mut JudgedCandidate) -> Option<OptimizeReport> {
        let (earlier, found) = match self.measure(place, view, judged) {
            Ok(measured) => measured,
            Err(decision) => {
                judged.decision = decision;
                return None;
            }
        };
        let Some(information) = information_of(&found, &self.settings.common_sigmas) else {
            judged.decision = LoopDecision::Degenerate;
            return None;
        };
        let measured =
            LoopMeasurement { from: earlier, to: *place, from_from_to: found.earlier_from_view, information };
        match self.close(&measured, judged) {
            Ok(report) => {
                judged.decision = LoopDecision::Accepted;
                self.last_closed = Some(place.keyframe_id);
                Some(report)
            }
            Err(decision) => {
                judged.decision = decision;
                None
            }
        }
    }

    /// Compares the view with that of the candidate.
    fn measure(
        &mut self,
        place: &Place,
        view: &PlaceView<'_>,
        judged: &mut JudgedCandidate,
    ) -> Result<(Place, VerifiedLoop), LoopDecision> {
        let PlaceCandidate { ordinal, .. } = judged.candidate;
        if !self.recognizer.is_consistent(&judged.candidate) {
            return Err(LoopDecision::NotConsistent);
        }
        let is_soon = |last: u32| place.keyframe_id - last < self.settings.min_keyframes_between;
        if self.last_closed.is_some_and(is_soon) {
            return Err(LoopDecision::TooSoon);
        }
        let (earlier, seen) = self.kept.find(ordinal).ok_or(LoopDecision::Forgotten)?;
        let mut rng = Rng::new(SEED, place.keyframe_id.into(), ordinal.into());
        let settings = &self.settings.verification;
        let (found, evidence) =
            verify_loop(self.simd, &self.camera, view, &seen, settings, &mut rng, &mut self.scratch);
        judged.evidence = Some(evidence);
        found.map(|found| (earlier, found)).ok_or(LoopDecision::NotVerified)
    }

    /// Puts the loop into the graph, and takes it back if the rest does not agree.
    fn close(
        &mut self,
        measured: &LoopMeasurement,
        judged: &mut JudgedCandidate,
    ) -> Result<OptimizeReport, LoopDecision> {
        self.graph.push_loop(measured).map_err(LoopDecision::NotPushed)?;
        let refused = match self.optimize() {
            Ok(report) => {
                judged.added_cost = report.cost_after - self.cost;
                judged.squared_sigmas = self.graph.loops().last().map_or(f64::NAN, |own| own.squared_sigmas);
                let bar = self.settings.max_added_sigmas * self.settings.max_added_sigmas;
                if report.n_rejected > 0 {
                    LoopDecision::Contradicted
                } else if judged.added_cost <= bar {
                    self.cost = report.cost_after;
                    return Ok(report);
                } else {
                    LoopDecision::TooFarOff
                }
            }
            Err(full) => LoopDecision::NotSolved(full),
        };
        self.graph.pop_loop();
        self.graph.lay_out();
        // These loops were solved before in this memory.
        let _ = self.optimize();
        Err(refused)
    }

    /// The cost of a loop is that of the whole graph with it, less that without it.
    fn optimize(&mut self) -> Result<OptimizeReport, SolverFull> {
        let settings = OptimizeSettings { extent: Extent::Whole, ..self.settings.optimize };
        self.graph.optimize(&settings, &mut self.solver)
    }
}

/// Information of the right increment of a loop, with the error that all its points have in common.
fn information_of(found: &VerifiedLoop, common_sigmas: &[f64; 3]) -> Option<Matrix7> {
    let left_from_right = sim3::adjoint(&found.earlier_from_view);
    let by_points = left_from_right.transpose() * found.information * left_from_right;
    let [r, t, s] = common_sigmas.map(|sigma| sigma * sigma);
    let common = Matrix7::from_diagonal(&Tangent7::from([r, r, r, t, t, t, s]));
    let covariance = by_points.cholesky()?.inverse() + common;
    let information = covariance.cholesky()?.inverse();
    information.iter().all(|x| x.is_finite()).then_some(information)
}
