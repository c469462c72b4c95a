//! The loop-closing thread: recognizes places, and moves the map when one is seen again.

use super::SharedAlignment;
use super::link::{Job, LoopEnd, LoopLink};
use super::places_file::{KnownPlace, PlacesFile};
use super::{memory, vocabulary};
use crate::budget::{Row, Usage};
use crate::map_store::{Alignment, MapStoreReader};
use crate::output::LoopTable;
use crate::pipeline::matchers::kept;
use crate::pipeline::plan::RunPlan;
use crate::pipeline::resume::{Resume, map_from_keyframe};
use crate::run_error::RunError;
use kilogs_core::conventions::Similarity;
use kilogs_core::features::descriptors::{extract, half_step_bytes};
use kilogs_core::features::{Corner, ExtractScratch, ExtractSettings, Feature, SimdLevel};
use kilogs_core::frame::{ImageView, Pyramid, pyramid};
use kilogs_core::loop_closure::{
    JudgedCandidate, KeyframeOutcome, KeyframePacket, LoopCapacities, LoopCloser, LoopDecision, OdometryNoise,
};
use kilogs_core::places::{PlaceView, PointDepth, describe_points};
use kilogs_core::pose_graph::Place;
use kilogs_core::tracking::{FrameReport, PYRAMID_LEVELS};
use std::path::PathBuf;
use std::sync::Arc;

/// A drive that is not recognized for so many keyframes goes on where the last one ended.
///
/// On KITTI 00 the 13th keyframe of a known street was the first to be verified.
const KEYFRAMES_UNTIL_LOCATED: usize = 24;
/// A map that was closed before does not bend as odometry does: information of its steps, relative to that of odometry.
const KNOWN_MAP_WEIGHT: f64 = 100.0;

/// The loop closer's end, and everything it owns.
pub struct LoopWork {
    closer: LoopCloser<'static>,
    eye: Eye,
    jobs: LoopEnd,
    noise: OdometryNoise,
    /// Every keyframe that was looked at, where odometry put it.
    places: Vec<Place>,
    /// Of these: keyframes of earlier drives.
    n_known: usize,
    /// How they had moved when the drive began.
    before: Alignment,
    alignment: SharedAlignment,
    /// Where the alignment is written; none without a map.
    map: Option<PathBuf>,
    resume: Option<Resume>,
    table: LoopTable,
    usage: Arc<Usage>,
    /// From this keyframe on it is a guess where in the map the drive is, until a loop says it.
    lost_from: Option<u32>,
    n_loops: u64,
    n_refused: u64,
}

/// What closing loops did.
#[derive(Debug, Clone, Copy, Default)]
pub struct LoopSummary {
    /// Loops that were closed.
    pub n_loops: u64,
}

/// Takes all memory of closing loops; `None` when that is switched off or there is no vocabulary.
///
/// # Errors
/// [`RunError`] when a file cannot be made, or the storage does not fit, a defect of this function.
pub fn prepare(
    plan: &RunPlan,
    usage: &Arc<Usage>,
    alignment: &SharedAlignment,
) -> Result<Option<(LoopLink, LoopWork)>, RunError> {
    let settings = &plan.settings.loop_closure;
    // Given poses are where they are.
    if !settings.enabled || plan.given_poses.is_some() {
        return Ok(None);
    }
    let (vocabulary, vocabulary_crc) = match vocabulary::find(&settings.vocabulary) {
        Ok(vocabulary) => vocabulary,
        Err(problem) => {
            log::warn!("closing loops: {problem}; the drive goes on without");
            return Ok(None);
        }
    };
    let n_points = plan.budget.capacity(Row::LoopsPoints);
    let capacities = LoopCapacities {
        places: plan.budget.capacity(Row::LoopsPlaces),
        words: vocabulary.n_words(),
        features: n_points,
        points: n_points,
        graph: plan.budget.loop_graph(),
    };
    let map = plan.settings.mapping.enabled.then(|| plan.map_folder());
    let file = match &map {
        Some(map) => PlacesFile::of_map(map, n_points, vocabulary_crc),
        None => PlacesFile::nameless(&plan.out, n_points, vocabulary_crc),
    };
    let folder = map.as_ref().unwrap_or(&plan.out).display();
    let points =
        file.map_err(|e| RunError::Run(format!("making a file for the places of the drive in {folder}: {e}")))?;
    let known = points.known(capacities.places);
    let storage = memory::storage(&capacities, points);
    let closer = LoopCloser::new(SimdLevel::new(), plan.camera, vocabulary, settings.closer, &capacities, storage)
        .map_err(|e| RunError::Run(format!("setting up the loop closer: {e}")))?;
    let before = alignment.lock().clone();
    let n_keyframes = plan.budget.capacity(Row::LoopsKeyframes);
    let mut known_map = KnownMap { closer, places: Vec::with_capacity(n_keyframes), noise: settings.noise };
    if let Some(resume) = &plan.resume {
        known_map.recall(&MapStoreReader::open(&resume.map, usize::MAX)?, &known, &before);
    }
    let KnownMap { closer, places, noise } = known_map;
    let is_pose_given = plan.resume.as_ref().is_none_or(|resume| resume.is_pose_given);
    alignment.set_located(places.is_empty() || is_pose_given);
    let (link, jobs) = LoopLink::new(plan, usage, alignment);
    let work = LoopWork {
        n_known: places.len(),
        before,
        closer,
        eye: Eye::new(plan, n_points),
        jobs,
        noise,
        places,
        alignment: alignment.clone(),
        map,
        resume: plan.resume.clone(),
        table: LoopTable::create(&plan.out)?,
        usage: Arc::clone(usage),
        lost_from: (!alignment.is_located()).then(|| plan.first_keyframe_id()),
        n_loops: 0,
        n_refused: 0,
    };
    Ok(Some((link, work)))
}

impl LoopWork {
    /// Looks at keyframes until no more come.
    ///
    /// # Errors
    /// [`RunError::Store`] when the map could not be moved on disk, [`RunError::Output`] when a decision could not be written.
    pub fn run(mut self) -> Result<LoopSummary, RunError> {
        while let Some(job) = self.jobs.0.pop() {
            if let Some(report) = job.report {
                let report = self.resume.as_ref().map_or(report, |resume| resume.in_map(&report));
                self.keyframe(&job, &report)?;
            }
            // The tracking thread is gone only when the run ends: nobody misses the job then.
            let _ = self.jobs.1.push(job);
        }
        if self.n_refused > 0 {
            log::warn!("closing loops: {} keyframes were not looked at, because [loops.*] is full", self.n_refused);
        }
        self.table.finish()?;
        Ok(LoopSummary { n_loops: self.n_loops })
    }

    fn keyframe(&mut self, job: &Job, report: &FrameReport) -> Result<(), RunError> {
        if self.places.len() == self.places.capacity() {
            self.refuse(Row::LoopsKeyframes);
            return Ok(());
        }
        let Some((features, points)) = self.eye.look(job) else { return Ok(()) };
        let odometry_from_camera = report.world_from_camera;
        let odometry_from_keyframe = Similarity::from_isometry(odometry_from_camera, 1.0);
        let place = Place { keyframe_id: report.keyframe_ordinal, odometry_from_keyframe };
        let before = self.places.last().unwrap_or(&place).odometry_from_keyframe.isometry;
        let step_m = (before.inverse() * odometry_from_camera).translation.vector.norm();
        if job.blind.is_some() {
            self.closer.note_lost(report.keyframe_ordinal);
            self.lost_from.get_or_insert(report.keyframe_ordinal);
        }
        let packet = KeyframePacket {
            ordinal: report.keyframe_ordinal,
            odometry_from_camera,
            information: match (self.places.len(), job.blind) {
                (n, _) if n == self.n_known && n > 0 => OdometryNoise::unknown_start(),
                (_, Some(grown)) => self.noise.blind_information(step_m, &grown, report.scale_sigma.into()),
                _ => self.noise.information(step_m),
            },
            features,
            points,
        };
        let outcome = match self.closer.observe(&packet) {
            Ok(outcome) => outcome,
            Err(problem) => {
                log::debug!("keyframe {} is no node of the pose graph: {problem}", report.keyframe_ordinal);
                self.refuse(Row::LoopsGraphNodes);
                return Ok(());
            }
        };
        self.places.push(place);
        for (row, n) in [
            (Row::LoopsPlaces, self.closer.n_places()),
            (Row::LoopsKeyframes, self.places.len()),
            (Row::LoopsGraphNodes, self.closer.n_nodes()),
            (Row::LoopsWorkspaces, 1),
        ] {
            self.usage.observe(row, n);
        }
        // Rows of a run name frames as frames.csv does.
        let frame_index = job.report.map_or(report.frame_index, |own| own.frame_index);
        self.table.keyframe(frame_index, report.keyframe_ordinal, &outcome)?;
        for judged in &outcome.candidates {
            tell(report, judged);
        }
        if outcome.optimized.is_some() {
            self.n_loops += 1;
            self.align()?;
        }
        self.locate(report, &outcome);
        Ok(())
    }

    /// A loop with what was before says where in the map the drive is. Who is not recognized for long is somewhere else.
    fn locate(&mut self, report: &FrameReport, outcome: &KeyframeOutcome) {
        let Some(lost_from) = self.lost_from else { return };
        let n_keyframes = self.places.iter().rev().take_while(|place| place.keyframe_id >= lost_from).count();
        let is_of_before = |judged: &JudgedCandidate| {
            judged.decision == LoopDecision::Accepted && judged.candidate.ordinal < lost_from
        };
        if outcome.candidates.iter().any(is_of_before) {
            log::info!(
                "recognized: keyframe {n_keyframes} of a lost drive (frame {}) is in the map",
                report.frame_index
            );
            self.lost_from = None;
            self.alignment.set_located(true);
            self.alignment.note_found();
        } else if !self.alignment.is_located() && n_keyframes >= KEYFRAMES_UNTIL_LOCATED {
            log::warn!(
                "{n_keyframes} keyframes of the drive are of no street in the map: it goes on where the last one ended; \
                 say where it began with --resume-pose"
            );
            self.alignment.set_located(true);
        }
    }

    fn refuse(&mut self, row: Row) {
        self.n_refused += 1;
        self.usage.refuse(row, 1);
    }

    /// Says where all keyframes are by now; what is on disk follows.
    fn align(&mut self) -> Result<(), RunError> {
        let moved = |place: &Place| {
            let world_from_keyframe = self.closer.world_from_keyframe(place)?;
            let moved = world_from_keyframe * place.odometry_from_keyframe.inverse();
            Some((place.keyframe_id, moved * self.before.at(place.keyframe_id)))
        };
        let mut alignment = self.alignment.lock();
        alignment.truncate_from(self.places.first().map_or(0, |first| first.keyframe_id));
        for (keyframe_id, map_from_unaligned) in self.places.iter().filter_map(moved) {
            alignment.push(keyframe_id, map_from_unaligned);
        }
        let Some(map) = &self.map else { return Ok(()) };
        // Nobody waits for the disk.
        let written = alignment.clone();
        drop(alignment);
        Ok(written.write(map)?)
    }
}

/// A closer that gets to know a map before the drive begins.
struct KnownMap {
    closer: LoopCloser<'static>,
    places: Vec<Place>,
    noise: OdometryNoise,
}

impl KnownMap {
    /// Knows the places of a stored map again, where its keyframes are now; `alignment` is how they moved.
    fn recall(&mut self, map: &MapStoreReader, known: &[KnownPlace], alignment: &Alignment) {
        for KnownPlace { slot, keyframe_id, words } in known {
            let Some(keyframe) = map.keyframe(*keyframe_id) else { continue };
            let map_from_keyframe = map_from_keyframe(keyframe);
            // Its points are in metres of the odometry that it was seen with.
            let scale = alignment.at(*keyframe_id).scaling();
            let odometry_from_keyframe = Similarity::from_isometry(map_from_keyframe, scale);
            let place = Place { keyframe_id: *keyframe_id, odometry_from_keyframe };
            let before = self.places.last().unwrap_or(&place).odometry_from_keyframe.isometry;
            let step_m = (before.inverse() * map_from_keyframe).translation.vector.norm();
            let information = self.noise.information(step_m) * KNOWN_MAP_WEIGHT;
            if self.places.len() < self.places.capacity()
                && self.closer.recall(*slot, &place, words, &information).is_ok()
            {
                self.places.push(place);
            }
        }
    }
}

/// The numbers that decided about a candidate.
fn tell(report: &FrameReport, judged: &JudgedCandidate) {
    let (id, frame, old) = (report.keyframe_ordinal, report.frame_index, judged.candidate.ordinal);
    let Some(evidence) = judged.evidence else { return };
    if judged.decision == LoopDecision::Accepted {
        log::info!(
            "loop: keyframe {id} (frame {frame}) sees the place of keyframe {old}: {} inliers, scale {:.4}, residual {:.1}, \
             cost {:.1} squared sigmas",
            evidence.n_inliers,
            evidence.scale,
            judged.squared_sigmas,
            judged.added_cost
        );
    } else {
        log::debug!("no loop: keyframe {id} (frame {frame}), keyframe {old}: {:?}, {evidence:?}", judged.decision);
    }
}

/// Finds and describes what a keyframe shows.
struct Eye {
    simd: SimdLevel,
    size: [usize; 2],
    pyramid: &'static mut [u8],
    half_step: &'static mut [u8],
    corners: &'static mut [Corner],
    features: &'static mut [Feature],
    points: &'static mut [Feature],
    depths: &'static mut [PointDepth],
}

impl Eye {
    fn new(plan: &RunPlan, n_points: usize) -> Self {
        let size @ [width, height] = [plan.camera.width as usize, plan.camera.height as usize];
        Self {
            simd: SimdLevel::new(),
            size,
            pyramid: kept(0, pyramid::bytes_needed(width, height, PYRAMID_LEVELS)),
            half_step: kept(0, half_step_bytes(width, height)),
            corners: kept(Corner::NONE, n_points.div_ceil(2)),
            features: kept(Feature::NONE, n_points),
            points: kept(Feature::NONE, n_points),
            depths: kept(PointDepth::default(), n_points),
        }
    }

    /// The features that become words, and the points by which another view is measured; `None` for an image that is no
    /// image.
    fn look(&mut self, job: &Job) -> Option<(&[Feature], PlaceView<'_>)> {
        let [width, height] = self.size;
        let image = ImageView::new(&job.gray, width, height, width).ok()?;
        let mut pyramid = Pyramid::new(self.pyramid, width, height, PYRAMID_LEVELS).ok()?;
        pyramid.build(image).ok()?;
        let mut scratch = ExtractScratch { half_step: self.half_step, corners: self.corners };
        let n = extract(self.simd, &pyramid, &ExtractSettings::STANDARD, &mut scratch, self.features);
        let n_points = describe_points(self.simd, &pyramid, &job.points, self.points, self.depths);
        let points = PlaceView { features: &self.points[..n_points], depths: &self.depths[..n_points] };
        Some((&self.features[..n], points))
    }
}

/// What is known of earlier drives in this map before the first keyframe of this one.
pub fn alignment_before(plan: &RunPlan) -> Result<Alignment, RunError> {
    let mut alignment = Alignment::with_capacity(plan.budget.capacity(Row::LoopsKeyframes));
    if let Some(resume) = &plan.resume {
        // A damaged one was told when the map was opened.
        let stored = Alignment::read(&resume.map)?.unwrap_or_default();
        alignment.go_on_after(&stored, resume.first_keyframe_id);
    }
    Ok(alignment)
}
