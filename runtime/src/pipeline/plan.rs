//! What a run is going to do, checked before anything is started.

use super::given_poses::GivenPosesPlan;
use super::resume::Resume;
use crate::budget::{Budget, ComputeMemory, Location, MappingPlan, Plan, PlanInput, Row};
use crate::cli::{CommonArgs, ResumeArgs};
use crate::compute::{BackendPlan, Compute};
use crate::input::ServiceFormat;
use crate::map_store::MapStoreReader;
use crate::run_error::RunError;
use crate::settings::Settings;
use crate::splat::cpu::SimdLevel;
use crate::splat::kernel_constants::MAX_IMAGE_SIDE_PX;
use kilogs_camera::source::{PixelFormat, SourceFormat};
use kilogs_core::camera::{Mounting, Pinhole};
use kilogs_core::conventions::Rigid;
use std::path::{Path, PathBuf};

/// Who sets the pace.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pace {
    /// Every frame is processed and every keyframe trained for a fixed number of steps: same input, same bytes.
    LockStep {
        /// Training steps per keyframe.
        iterations: u32,
    },
    /// The camera does; what is late is dropped and counted.
    Live,
}

/// What the tracker goes by where given poses tell the scale: a level camera at the height of a car's mirror.
const ASSUMED_MOUNTING: Mounting =
    Mounting { height_m: 1.4, pitch_rad: 0.0, roll_rad: 0.0, forward_axis: [0.0, 0.0, 1.0], lever_arm_m: [0.0; 3] };

/// What a run is going to do.
#[derive(Debug, Clone)]
pub struct RunPlan {
    /// Settings of all layers.
    pub settings: Settings,
    /// Capacities.
    pub budget: Budget,
    /// What the costs of the capacities depend on.
    pub memory_input: PlanInput,
    /// What the capacities cost with this camera.
    pub memory: Plan,
    /// Size and intrinsics.
    pub camera: Pinhole,
    /// How the camera sits on the vehicle.
    pub mounting: Option<Mounting>,
    /// What the pixels will be, or the most expensive they may be.
    pub pixel_format: PixelFormat,
    /// Frames that will come, where that is known.
    pub n_frames: Option<u64>,
    /// Who sets the pace.
    pub pace: Pace,
    /// The vehicle may drive backwards.
    pub may_reverse: bool,
    /// Where the camera was, instead of what the tracker finds; a comparison, not a drive.
    pub given_poses: Option<GivenPosesPlan>,
    /// The map to go on with; a new one without.
    pub resume: Option<Resume>,
    /// Folder for all outputs.
    pub out: PathBuf,
    /// Seed of everything random.
    pub seed: u64,
    /// Instruction set of the CPU kernels.
    pub simd: SimdLevel,
    /// Threads of the mapper.
    pub n_threads: usize,
    /// What computes the map.
    pub compute: Compute,
    /// The command line as typed, for the report.
    pub command: String,
}

impl RunPlan {
    /// Reads settings and budget and makes sure that the run fits.
    ///
    /// # Errors
    /// [`RunError`] of configuration, budget, device or usage.
    pub fn new(args: &CommonArgs, format: SourceFormat, pace: Pace, out: &Path) -> Result<Self, RunError> {
        let settings = mapping_settings(args, &format)?;
        let budget = args.budget()?;
        let training_resolution = settings.mapping.mapper.resolution;
        Self::of_parts(args, format, pace, out, (settings, budget, training_resolution))
    }

    /// A run over views whose places are known: it trains up to native resolution, and needs no scale. `mapping.resolution`
    /// is that of the insertion.
    ///
    /// # Errors
    /// [`RunError`] of configuration, budget or device.
    pub fn for_given_views(
        args: &CommonArgs,
        format: SourceFormat,
        out: &Path,
        max_gaussians: Option<usize>,
    ) -> Result<Self, RunError> {
        let mut settings = mapping_settings(args, &format)?;
        // Pages leave when they are trained, wherever they are.
        settings.mapping.mapper.page_distance_m = f64::INFINITY;
        // Views are trained in any order and at their own size, long after their depth was estimated.
        settings.mapping.mapper.step.weights.depth = 0.0;
        settings.loop_closure.enabled = false;
        let budget = args.budget()?;
        let budget = max_gaussians.map_or(Ok(budget.clone()), |n| budget.with_max_gaussians(n))?;
        check_views(format.n_frames.unwrap_or(0), budget.capacity(Row::StoreKeyframeTable) as u64)?;
        Self::of_parts(args, format, Pace::LockStep { iterations: 0 }, out, (settings, budget, 1.0))
    }

    /// The refinement of a stored map: it trains up to native resolution what `map` holds.
    ///
    /// # Errors
    /// [`RunError`] of configuration, budget or device.
    pub fn for_stored_map(args: &CommonArgs, budget: &Budget, map: &MapStoreReader) -> Result<Self, RunError> {
        let manifest = map.manifest();
        let n_frames = Some((map.keyframes().len() + map.held_out().len()) as u64);
        let (camera, mounting, pixel_format) = (manifest.camera, manifest.mounting, manifest.pixel_format);
        let format = SourceFormat { camera, mounting, pixel_format, n_frames };
        let mut settings = mapping_settings(args, &format)?;
        settings.mapping.mapper.learned_decoder = map.has_learned_decoder();
        settings.loop_closure.enabled = false;
        // Nothing is stored of a keyframe's depth.
        settings.mapping.mapper.step.weights.depth = 0.0;
        let budget = budget.with_gaussians_per_anchor(manifest.gaussians_per_anchor);
        let pace = Pace::LockStep { iterations: 0 };
        Self::of_parts(args, format, pace, map.folder(), (settings, budget, 1.0))
    }

    fn of_parts(
        args: &CommonArgs,
        format: SourceFormat,
        pace: Pace,
        out: &Path,
        (settings, budget, training_resolution): (Settings, Budget, f64),
    ) -> Result<Self, RunError> {
        if settings.mapping.enabled {
            check_image_size(&format.camera)?;
        }
        let simd = args.simd()?;
        let compute = args.compute()?;
        let mapper = &settings.mapping.mapper;
        let mapping = MappingPlan { resolution: training_resolution, ..MappingPlan::of(mapper, format.camera.width) };
        let memory_input = PlanInput {
            has_loops: settings.loop_closure.enabled,
            ..plan_input(&format, mapping, compute.memory(), settings.has_networks())
        };
        let memory = Plan::compute(&budget, &memory_input);
        memory.check()?;
        let command = std::env::args().collect::<Vec<_>>().join(" ");
        Ok(Self {
            settings,
            budget,
            memory_input,
            memory,
            camera: format.camera,
            mounting: format.mounting,
            pixel_format: format.pixel_format,
            n_frames: format.n_frames,
            pace,
            may_reverse: false,
            given_poses: None,
            resume: None,
            out: out.to_owned(),
            seed: args.seed,
            simd,
            n_threads: args.n_threads(pace == Pace::Live),
            compute,
            command,
        })
    }

    /// How the tracker takes the camera to sit on the vehicle.
    ///
    /// # Errors
    /// [`RunError::Usage`] when neither the camera's height nor given poses tell the scale.
    pub fn tracker_mounting(&self) -> Result<Mounting, RunError> {
        let assumed = self.given_poses.as_ref().map(|_| ASSUMED_MOUNTING);
        self.mounting.or(assumed).ok_or_else(|| {
            RunError::Usage(
                "planning the run: the camera's height over the road is unknown, and with it the scale; \
                 give --camera kitti, or a camera.toml with height_m"
                    .to_owned(),
            )
        })
    }

    /// Frames come at the camera's pace.
    pub fn is_live(&self) -> bool {
        self.pace == Pace::Live
    }

    /// Goes on with a stored map.
    ///
    /// # Errors
    /// [`RunError::Store`] when it cannot be opened.
    pub fn resume(&mut self, args: &ResumeArgs) -> Result<(), RunError> {
        let max_views = self.budget.capacity(Row::StoreKeyframeTable);
        let open = |map: &PathBuf| Resume::open(map, args.resume_pose, max_views);
        self.resume = args.resume.as_ref().map(open).transpose()?;
        Ok(())
    }

    /// Folder of the map.
    pub fn map_folder(&self) -> PathBuf {
        self.resume.as_ref().map_or_else(|| self.out.join("map"), |resume| resume.map.clone())
    }

    /// Where the odometry begins in the map.
    pub fn map_from_odometry(&self) -> Rigid {
        self.resume.as_ref().map_or_else(Rigid::identity, |resume| resume.map_from_odometry)
    }

    /// Id in the map of the drive's first keyframe.
    pub fn first_keyframe_id(&self) -> u32 {
        self.resume.as_ref().map_or(0, |resume| resume.first_keyframe_id)
    }

    /// What the splat backend is made of.
    pub fn backend(&self) -> BackendPlan {
        BackendPlan {
            capacities: self.budget.splat_capacities(&self.memory_input),
            arena_cap_bytes: self.memory.arena_bytes(),
            has_substitute: self.budget.entry(Row::MapAnchors).location == Location::Both,
            n_threads: self.n_threads,
            simd: self.simd,
        }
    }

    /// Bytes of one frame on the wire.
    pub fn frame_bytes(&self) -> usize {
        self.pixel_format.packed_bytes(self.camera.width, self.camera.height) as usize
    }

    /// What every frame must look like.
    pub fn service_format(&self) -> ServiceFormat {
        ServiceFormat { width: self.camera.width, height: self.camera.height, pixel_format: None }
    }
}

/// All views are in memory while a map is fitted, and in the table of its keyframes afterwards.
fn check_views(n_views: u64, capacity: u64) -> Result<(), RunError> {
    if n_views > capacity {
        return Err(RunError::Usage(format!(
            "planning the run: {n_views} views, and [store.keyframe_table] of the budget holds {capacity}; \
             raise it, or give fewer --frames"
        )));
    }
    Ok(())
}

/// Settings with the training resolution that this camera gets.
fn mapping_settings(args: &CommonArgs, format: &SourceFormat) -> Result<Settings, RunError> {
    let mut settings = args.settings()?;
    let mapper = &mut settings.mapping.mapper;
    mapper.resolution = mapper.resolution_for(format.camera.width);
    Ok(settings)
}

fn plan_input(format: &SourceFormat, mapping: MappingPlan, compute: ComputeMemory, has_networks: bool) -> PlanInput {
    PlanInput {
        width: format.camera.width,
        height: format.camera.height,
        frame_bytes: format.frame_bytes(),
        color_channels: if format.pixel_format == PixelFormat::Mono8 { 1 } else { 3 },
        mapping,
        compute,
        has_networks,
        has_loops: false,
    }
}

fn check_image_size(camera: &Pinhole) -> Result<(), RunError> {
    let Pinhole { width, height, .. } = *camera;
    if width.max(height) > MAX_IMAGE_SIDE_PX {
        return Err(RunError::Usage(format!(
            "planning the run: the images have {width} x {height} px; use images of at most {MAX_IMAGE_SIDE_PX} px a side"
        )));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_that_no_backend_draws_is_a_matter_of_usage() {
        for (width, height, code) in [(4096, 4096, None), (4097, 100, Some(2)), (100, 5000, Some(2))] {
            let camera = Pinhole { width, height, fx: 1.0, fy: 1.0, cx: 1.0, cy: 1.0 };
            assert_eq!(check_image_size(&camera).map_err(|e| e.code()).err(), code, "{width} x {height}");
        }
    }

    #[test]
    fn more_views_than_the_map_can_list_are_refused() {
        assert!(check_views(64, 64).is_ok());
        let refusal = check_views(65, 64).expect_err("one too many");
        assert_eq!(refusal.code(), 2);
        assert!(refusal.to_string().contains("65 views, and [store.keyframe_table]"), "{refusal}");
    }
}
