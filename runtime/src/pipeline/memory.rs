//! Takes the memory of a run from its budget, once.

use super::matchers::kept;
use super::plan::RunPlan;
use crate::budget::Row;
use crate::map_store::{DEFAULT_JPEG_QUALITY, StoreSettings, WhenBusy};
use crate::mapping::{Mapper, MapperSettings};
use crate::run_error::RunError;
use crate::splat::SplatBackend;
use kilogs_core::correspondence::PixelMatch;
use kilogs_core::features::corners::Corner;
use kilogs_core::features::lk::Flow;
use kilogs_core::features::tracks::{Track, TrackStorage};
use kilogs_core::frame::PixelFormat;
use kilogs_core::keyframe::Landmark;
use kilogs_core::map::lod::{N_LEVELS, VOXEL_SIZES_M};
use kilogs_core::pose::{LandmarkMatch, Match};
use kilogs_core::store::Manifest;
use kilogs_core::tracking::{KeyframePoint, Tracker, TrackerStorage};

/// The mapper with its backend.
///
/// # Errors
/// [`RunError::Device`] when the backend cannot be set up.
pub fn mapper(plan: &RunPlan) -> Result<Mapper, RunError> {
    let settings = MapperSettings { seed: plan.seed, ..plan.settings.mapping.mapper };
    let channels = if plan.pixel_format == PixelFormat::Mono8 { 1 } else { 3 };
    let mut mapper = Mapper::new(settings, plan.budget.mapper_capacity(), &plan.camera, channels, backend(plan)?);
    if plan.given_poses.is_some() {
        mapper.trust_poses();
    }
    Ok(mapper)
}

/// A backend of the budget's size.
///
/// # Errors
/// [`RunError`] of the device, or of the row that it cannot hold.
pub fn backend(plan: &RunPlan) -> Result<Box<dyn SplatBackend>, RunError> {
    plan.compute.open(&plan.backend())
}

/// What the map says about itself.
pub fn manifest(plan: &RunPlan) -> Manifest {
    let mut voxel_m = [0.0; _];
    for (stored, size_m) in voxel_m.iter_mut().zip(VOXEL_SIZES_M) {
        *stored = size_m;
    }
    Manifest {
        camera: plan.camera,
        mounting: plan.mounting,
        pixel_format: plan.pixel_format,
        voxel_m,
        n_levels: N_LEVELS as u32,
        gaussians_per_anchor: plan.budget.capacity(Row::MapGaussiansPerAnchor) as u32,
        counts: None,
    }
}

/// How the map is written.
pub fn store_settings(plan: &RunPlan) -> StoreSettings {
    StoreSettings {
        capacity: plan.budget.store_capacity(),
        jpeg_quality: DEFAULT_JPEG_QUALITY,
        when_busy: if plan.is_live() { WhenBusy::Refuse } else { WhenBusy::Wait },
    }
}

/// The tracker, on memory that lives as long as the process: it is taken once and never given back.
///
/// # Errors
/// [`RunError::Run`] when the storage does not fit the camera, a defect of this function.
pub fn tracker(plan: &RunPlan) -> Result<Tracker<'static>, RunError> {
    let capacities = plan.budget.tracker_capacities(&plan.memory_input);
    let n_tracks = capacities.tracks;
    let pyramid = || kept(0_u8, capacities.bytes_per_pyramid());
    let storage = TrackerStorage {
        pyramids: [pyramid(), pyramid(), pyramid()],
        tracks: TrackStorage {
            tracks: kept(Track::NONE, n_tracks),
            at_keyframe: kept(Track::NONE, n_tracks),
            flows: kept(Flow::new([0.0; 2], [0.0; 2]), n_tracks),
            corners: kept(Corner::NONE, n_tracks),
            distances_px: kept(0.0, n_tracks),
        },
        landmarks: kept(Landmark::default(), capacities.landmarks),
        pixel_matches: kept(PixelMatch::default(), n_tracks),
        matches: kept(Match::default(), n_tracks),
        landmark_matches: kept(LandmarkMatch::default(), n_tracks),
        is_inlier: kept(false, n_tracks),
        landmark_of_track: kept(0, n_tracks),
        landmark_of_match: kept(0, n_tracks),
        keyframe_points: kept(NO_POINT, n_tracks),
        bundle: Box::leak(Box::default()),
    };
    let mut settings = plan.settings.tracking.tracker;
    settings.motion.reverse_allowed |= plan.may_reverse;
    Tracker::new(
        plan.camera,
        plan.tracker_mounting()?,
        settings,
        kilogs_core::features::SimdLevel::new(),
        plan.seed,
        storage,
    )
    .map_err(|e| RunError::Run(format!("setting up the tracker: {e}")))
}

/// A place for a point of a keyframe.
const NO_POINT: KeyframePoint = KeyframePoint { pixel: [0.0; 2], depth_m: 0.0, relative_sigma: 0.0 };
