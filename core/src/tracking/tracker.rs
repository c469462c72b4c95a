//! The tracker: storage, state and the order of the stages.

use super::drift::Drift;
use super::frame_pose::{FramePose, Moment};
use super::recovery::{Aids, Travelled};
use super::settings::TrackingSettings;
use super::storage::{N_PYRAMIDS, TrackerStorage, TrackerStorageProblem};
use super::{FrameReport, FrameStatus, KeyframePoint, RoadPlane, StatusReason};
use crate::bundle::ReducedSystem;
use crate::camera::{Mounting, Pinhole};
use crate::conventions::{Rigid, TimestampNs};
use crate::correspondence::PixelMatch;
use crate::features::SimdLevel;
use crate::features::tracks::{TrackImages, TrackReport, TrackTable};
use crate::frame::pyramid::PyramidStorageTooSmall;
use crate::frame::{ImageView, Pyramid};
use crate::gate;
use crate::keyframe::{Keyframe, KeyframeWindow, Landmark};
use crate::math::se3;
use crate::pose::{LandmarkMatch, Match};
use crate::scale::ScaleFilter;
use crate::verify::MotionPrior;
use core::fmt;
use nalgebra::{Translation3, Vector3, Vector6};

/// Levels of every pyramid, the full image included.
pub const PYRAMID_LEVELS: usize = 4;
/// A turn is not predicted for longer than this, s: then the street goes straight on.
pub(super) const MAX_TURN_S: f64 = 1.0;
/// Prediction does not coast for longer than this, s: then the vehicle stands.
pub(super) const MAX_COAST_S: f64 = 10.0;
/// Nanoseconds per second.
const NS_PER_S: f64 = 1e9;
/// A track without a landmark.
pub(super) const NO_LANDMARK: u32 = u32::MAX;

/// Scratch slices, all as long as the track table.
pub(super) struct Scratch<'m> {
    pub(super) pixel_matches: &'m mut [PixelMatch],
    pub(super) matches: &'m mut [Match],
    pub(super) landmark_matches: &'m mut [LandmarkMatch],
    pub(super) is_inlier: &'m mut [bool],
    pub(super) landmark_of_track: &'m mut [u32],
    pub(super) landmark_of_match: &'m mut [u32],
}

/// The last believed pose and how it moves.
pub(super) struct Motion {
    pub(super) camera_from_world: Rigid,
    pub(super) timestamp_ns: TimestampNs,
    /// Tangent of `later_from_earlier` per second.
    pub(super) velocity: Vector6<f64>,
    pub(super) prior: Option<MotionPrior>,
}

impl Motion {
    /// Whether any speed has been measured, be it before the window was given up.
    pub(super) fn is_known(&self) -> bool {
        self.velocity != Vector6::zeros()
    }
}

/// Seconds from one timestamp to a later one.
pub(super) fn seconds_between(earlier_ns: TimestampNs, later_ns: TimestampNs) -> f64 {
    later_ns.saturating_sub(earlier_ns) as f64 / NS_PER_S
}

/// Follows one camera from image to image: every image in, one [`FrameReport`] out.
///
/// The order of the stages is that of [`step`](Self::step); nothing here allocates.
pub struct Tracker<'m> {
    pub(super) camera: Pinhole,
    pub(super) mounting: Mounting,
    pub(super) settings: TrackingSettings,
    pub(super) simd: SimdLevel,
    pub(super) seed: u64,
    pub(super) pyramids: [Pyramid<'m>; N_PYRAMIDS],
    pub(super) keyframe_slot: usize,
    pub(super) previous_slot: usize,
    pub(super) current_slot: usize,
    pub(super) n_slots_used: usize,
    pub(super) tracks: TrackTable<'m>,
    pub(super) landmarks: &'m mut [Landmark],
    pub(super) window: KeyframeWindow,
    pub(super) newest: Keyframe,
    pub(super) scratch: Scratch<'m>,
    pub(super) bundle: &'m mut ReducedSystem,
    pub(super) keyframe_points: &'m mut [KeyframePoint],
    pub(super) n_keyframe_points: usize,
    pub(super) motion: Motion,
    pub(super) scale: ScaleFilter,
    /// Keyframes since a measurement of the scale was merged.
    pub(super) n_unmeasured: u32,
    /// What the last measurement said of a scale that was forgotten.
    pub(super) unconfirmed_ratio: Option<f64>,
    /// Way since the last keyframe, as far as the wheels told it.
    pub(super) travelled: Option<Travelled>,
    /// Error of the last believed pose.
    pub(super) drift: Drift,
    pub(super) drift_at_keyframe: Drift,
    pub(super) expected_normal: Vector3<f64>,
    pub(super) road: Option<RoadPlane>,
    /// Whether the window has landmarks with metric depth.
    pub(super) is_started: bool,
    pub(super) n_doubtful: u32,
    last_timestamp_ns: Option<TimestampNs>,
}

impl fmt::Debug for Tracker<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (n_tracks, n_keyframes) = (self.tracks.tracks().len(), self.window.next_ordinal());
        write!(f, "Tracker {{ n_tracks: {n_tracks}, n_keyframes: {n_keyframes}, is_started: {} }}", self.is_started)
    }
}

impl<'m> Tracker<'m> {
    /// A tracker that has seen nothing. The first frame that it accepts defines the world.
    ///
    /// # Inputs
    /// * `camera`: size and intrinsics of every image to come, pixel centres at +0.5.
    /// * `mounting`: height, road normal, forward axis, rear axle.
    /// * `simd`: what the machine can do; results have the same bits on every level.
    /// * `seed`: of the robust loops.
    ///
    /// # Errors
    /// [`TrackerStorageProblem`] names the slice that is too small.
    pub fn new(
        camera: Pinhole,
        mounting: Mounting,
        settings: TrackingSettings,
        simd: SimdLevel,
        seed: u64,
        storage: TrackerStorage<'m>,
    ) -> Result<Self, TrackerStorageProblem> {
        let (shortest, needed) = storage.shortest();
        if shortest < needed {
            return Err(TrackerStorageProblem { what: "a scratch slice", found: shortest, needed });
        }
        let [first, second, third] = storage.pyramids;
        let tracks = TrackTable::new(storage.tracks).map_err(|e| TrackerStorageProblem {
            what: "a slice of the track table",
            found: e.shortest,
            needed: e.longest,
        })?;
        let identity = Rigid::identity();
        Ok(Self {
            camera,
            mounting,
            settings,
            simd,
            seed,
            pyramids: [pyramid(first, &camera)?, pyramid(second, &camera)?, pyramid(third, &camera)?],
            keyframe_slot: 0,
            previous_slot: 0,
            current_slot: 0,
            n_slots_used: 0,
            tracks,
            landmarks: storage.landmarks,
            window: KeyframeWindow::new(),
            newest: Keyframe { ordinal: 0, frame_index: 0, timestamp_ns: 0, camera_from_world: identity },
            scratch: Scratch {
                pixel_matches: storage.pixel_matches,
                matches: storage.matches,
                landmark_matches: storage.landmark_matches,
                is_inlier: storage.is_inlier,
                landmark_of_track: storage.landmark_of_track,
                landmark_of_match: storage.landmark_of_match,
            },
            bundle: storage.bundle,
            keyframe_points: storage.keyframe_points,
            n_keyframe_points: 0,
            motion: Motion { camera_from_world: identity, timestamp_ns: 0, velocity: Vector6::zeros(), prior: None },
            scale: ScaleFilter::new(&settings.scale),
            n_unmeasured: 0,
            unconfirmed_ratio: None,
            travelled: None,
            drift: Drift::none(),
            drift_at_keyframe: Drift::none(),
            expected_normal: mounting.road_normal_in_camera(),
            road: None,
            is_started: false,
            n_doubtful: 0,
            last_timestamp_ns: None,
        })
    }

    /// The window of keyframes with their newest poses.
    pub fn window(&self) -> &KeyframeWindow {
        &self.window
    }

    /// Triangulated points as the newest keyframe sees them.
    pub fn keyframe_points(&self) -> &[KeyframePoint] {
        self.keyframe_points.get(..self.n_keyframe_points).unwrap_or(&[])
    }

    /// The road as the newest keyframe sees it, `None` until it has been measured.
    pub fn road_plane(&self) -> Option<RoadPlane> {
        self.road
    }

    /// Takes one image and says where it was taken.
    ///
    /// Tracks -> pose (landmarks, else essential matrix) -> verification -> gate -> on a keyframe: sightings,
    /// new depths, bundle adjustment, road scale, new corners.
    ///
    /// # Inputs
    /// * `image`: grey, of the camera's size; another size is a lost frame.
    /// * `timestamp_ns`: ascending; a frame that is not later than the last one is a lost frame.
    ///
    /// # Output
    /// Pose, verdict and figures. Numbers are finite except where their documentation says NaN.
    pub fn step(&mut self, image: ImageView<'_>, frame_index: u64, timestamp_ns: TimestampNs) -> FrameReport {
        self.step_aided(image, frame_index, timestamp_ns, &mut Aids::default())
    }

    /// [`step`](Self::step) with what the caller can lend: matchers for when tracks break, sources of the scale.
    pub fn step_aided(
        &mut self,
        image: ImageView<'_>,
        frame_index: u64,
        timestamp_ns: TimestampNs,
        aids: &mut Aids<'_>,
    ) -> FrameReport {
        self.current_slot =
            (0..N_PYRAMIDS).find(|&slot| slot != self.keyframe_slot && slot != self.previous_slot).unwrap_or(0);
        self.n_slots_used = self.n_slots_used.max(self.current_slot + 1);
        let is_later = self.last_timestamp_ns.is_none_or(|last| timestamp_ns > last);
        if !is_later || self.pyramids[self.current_slot].build(image).is_err() {
            let pose = FramePose::lost(&self.motion, StatusReason::Unusable);
            return self.report(frame_index, timestamp_ns, &pose, &TrackReport::default());
        }
        self.note_travelled(aids.travelled);
        let before_ns = self.last_timestamp_ns.replace(timestamp_ns);
        let predicted = self.predict(timestamp_ns);
        if before_ns.is_some_and(|before_ns| self.is_frozen(seconds_between(before_ns, timestamp_ns))) {
            let pose = FramePose { reason: StatusReason::Frozen, ..FramePose::predicted(&predicted) };
            return self.report(frame_index, timestamp_ns, &pose, &TrackReport::default());
        }
        if self.window.is_empty() {
            let pose = self.start_window(frame_index, timestamp_ns, &predicted);
            return self.report(frame_index, timestamp_ns, &pose, &TrackReport::default());
        }
        let images = TrackImages {
            keyframe: &self.pyramids[self.keyframe_slot],
            previous: &self.pyramids[self.previous_slot],
            current: &self.pyramids[self.current_slot],
        };
        let mut track_report = self.tracks.advance(self.simd, images, &self.settings.tracks);
        self.link_landmarks();
        let moment = Moment { predicted, frame_index, timestamp_ns };
        let mut pose = self.frame_pose(&moment, &mut track_report, aids);
        self.previous_slot = self.current_slot;
        if pose.status == FrameStatus::Tracked {
            self.n_doubtful = 0;
            if !self.is_started {
                // Single steps are too short to know their length before there are landmarks.
                self.motion.camera_from_world = self.newest.camera_from_world;
                self.motion.timestamp_ns = self.newest.timestamp_ns;
            }
            self.drop_contradicted(&pose);
            if self.wants_keyframe(&pose, &track_report) {
                self.promote(frame_index, timestamp_ns, &mut pose, aids);
            } else {
                self.note_drift(&pose);
            }
            self.believe(&pose, timestamp_ns);
        } else {
            self.n_doubtful += 1;
            // What was seen so long ago is not seen again.
            let is_cold = self.seconds_since_last(timestamp_ns) > MAX_TURN_S;
            if is_cold || self.n_doubtful >= self.settings.max_doubtful_frames || pose.status == FrameStatus::Lost {
                self.abandon_window();
            }
            if is_cold {
                pose = self.start_window(frame_index, timestamp_ns, &predicted);
            }
        }
        self.report(frame_index, timestamp_ns, &pose, &track_report)
    }

    /// Seconds since the last frame whose pose was believed.
    pub(super) fn seconds_since_last(&self, timestamp_ns: TimestampNs) -> f64 {
        seconds_between(self.motion.timestamp_ns, timestamp_ns)
    }

    /// Constant velocity; after a while straight on, and after a long one no farther.
    fn predict(&self, timestamp_ns: TimestampNs) -> Rigid {
        let coasting_s = self.seconds_since_last(timestamp_ns).min(MAX_COAST_S);
        let turning_s = coasting_s.min(MAX_TURN_S);
        let velocity = &self.motion.velocity;
        let straight_m = velocity.fixed_rows::<3>(3) * (coasting_s - turning_s);
        let turned = se3::exp(&(velocity * turning_s)) * self.motion.camera_from_world;
        Translation3::from(straight_m) * turned
    }

    fn wants_keyframe(&self, pose: &FramePose, tracks: &TrackReport) -> bool {
        if pose.is_standing {
            return false;
        }
        let width_px = self.camera.width as usize;
        let mut limits = self.settings.gate;
        if !self.is_started {
            limits.min_flow_px = limits.min_flow_px.min(self.settings.first_flow_px as f32);
        }
        let change = gate::ViewChange {
            median_flow_px: tracks.median_flow_px,
            n_tracks: tracks.n_live,
            n_tracks_at_keyframe: self.tracks.n_at_keyframe(),
            width_px,
        };
        // What matches found again is nearer to the next frame than to a keyframe that tracks could not follow. Of landmarks
        // that are few there are fewer in every frame, and only a keyframe finds others.
        let is_urgent = pose.source != super::MatchSource::Tracks || pose.prior.is_some();
        (is_urgent || gate::judge(&change, &limits).is_keyframe()) && (self.is_started || pose.is_metric)
    }

    /// Whether the current image is the one before once more although the vehicle cannot have stopped in between.
    ///
    /// A sensor has noise: the same bytes twice come from a camera that hangs, or from a recording that was stretched.
    fn is_frozen(&self, duration_s: f64) -> bool {
        let stops_from_m_per_s = self.settings.hardest_braking_m_per_s2 * duration_s;
        let is_driving = self.motion.prior.as_ref().is_some_and(|p| p.speed_m_per_s > stops_from_m_per_s);
        let [before, now] = [self.previous_slot, self.current_slot].map(|slot| self.pyramids[slot].image());
        is_driving && (0..now.height()).all(|y| before.row(y) == now.row(y))
    }

    /// Takes over a believed pose.
    fn believe(&mut self, pose: &FramePose, timestamp_ns: TimestampNs) {
        let duration_s = self.seconds_since_last(timestamp_ns);
        let later_from_earlier = pose.camera_from_world * self.motion.camera_from_world.inverse();
        let velocity = se3::log(&later_from_earlier) / duration_s;
        if duration_s > 0.0 && velocity.iter().all(|v| v.is_finite()) {
            self.motion.velocity = velocity;
            self.motion.prior = Some(MotionPrior {
                rotation_rate: Vector3::new(velocity[0], velocity[1], velocity[2]),
                speed_m_per_s: f64::from(pose.step_m(&self.mounting, &later_from_earlier)) / duration_s,
            });
        }
        self.motion.camera_from_world = pose.camera_from_world;
        self.motion.timestamp_ns = timestamp_ns;
    }

    /// Remembers the newest keyframe, to which reports are relative even after the window was given up.
    pub(super) fn note_newest(&mut self) {
        if let Some(newest) = self.window.newest() {
            self.newest = *newest;
        }
    }

    fn report(
        &self,
        frame_index: u64,
        timestamp_ns: TimestampNs,
        pose: &FramePose,
        tracks: &TrackReport,
    ) -> FrameReport {
        let world_from_camera = pose.camera_from_world.inverse();
        let is_believed = pose.status == FrameStatus::Tracked;
        let drift = if is_believed { self.drift } else { self.blind_drift(pose, timestamp_ns) };
        FrameReport {
            frame_index,
            timestamp_ns,
            status: pose.status,
            reason: pose.reason,
            model: pose.model,
            source: pose.source,
            is_keyframe: pose.is_keyframe,
            keyframe_ordinal: self.newest.ordinal,
            keyframe_from_camera: self.newest.camera_from_world * world_from_camera,
            world_from_camera,
            covariance: drift.covariance(),
            n_tracks: self.tracks.tracks().len() as u32,
            n_matches: pose.n_matches as u32,
            n_inliers: pose.n_inliers as u32,
            n_dynamic: pose.n_dynamic as u32,
            median_flow_px: tracks.median_flow_px,
            gric: pose.choice.map_or([f32::NAN; 2], |c| [c.gric_essential as f32, c.gric_homography as f32]),
            rotation_anomaly_rad: pose.turn_change_rad as f32,
            direction_anomaly_rad: pose.side_slip_rad as f32,
            step_m: (self.newest.camera_from_world * world_from_camera).translation.vector.norm() as f32,
            scale_ratio: pose.scale_ratio as f32,
            scale_sigma: self.scale.sigma() as f32,
            scale_sources: pose.scale_sources,
            n_road: pose.n_road as u32,
        }
    }
}

/// An empty pyramid of the camera's size.
fn pyramid<'m>(bytes: &'m mut [u8], camera: &Pinhole) -> Result<Pyramid<'m>, TrackerStorageProblem> {
    let problem =
        |e: PyramidStorageTooSmall| TrackerStorageProblem { what: "a pyramid", found: e.bytes, needed: e.needed };
    Pyramid::new(bytes, camera.width as usize, camera.height as usize, PYRAMID_LEVELS).map_err(problem)
}
