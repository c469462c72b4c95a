//! `kilogs replay`: a recorded sequence through a capture process of its own.

use super::{CommonArgs, ResumeArgs};
use crate::fit::{SceneError, line_of};
use crate::input::CameraChild;
use crate::pipeline::{self, GivenPosesPlan, Pace, RunPlan};
use crate::pose_file::PoseFile;
use crate::run_error::RunError;
use kilogs_camera::cli::{CameraError, parse_rate};
use kilogs_camera::source::{CameraDescription, DegradeArgs, PlaybackRange, Schedule, SpeedFile};
use std::path::{Path, PathBuf};

/// Mapping iterations per keyframe in lock-step, unless told otherwise.
pub const DEFAULT_ITERATIONS: u32 = 20;

/// Options of `kilogs replay`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Examples:\n  kilogs replay ../shared/data/kitti04-full --camera kitti --out out/04\n  \
    kilogs replay DATASET --camera camera.toml --live --rate 0.5 --out out/live\n  \
    kilogs replay DATASET --camera kitti --poses DATASET/poses.txt --out out/given\n  \
    kilogs replay DATASET --camera kitti --degrade gap@100..110 --degrade rain@150..200 --out out/spoilt\n  \
    kilogs replay DATASET --camera kitti --start 500 --resume out/04/map --out out/04b")]
pub struct ReplayArgs {
    /// Folder in the layout of KITTI odometry.
    pub dataset: PathBuf,
    /// Folder for all outputs.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// camera.toml, or the preset `kitti` (1.65 m over the road, axes aligned; intrinsics from the data set).
    #[arg(long, value_name = "FILE|kitti")]
    pub camera: Option<String>,
    /// Frames per second, where times.txt is missing.
    #[arg(long)]
    pub fps: Option<f64>,
    /// Wheel speed, `t_seconds metres_per_second sigma` on a line, on the clock of the frames; the default is speed.txt in
    /// the folder, where there is one.
    #[arg(long, value_name = "FILE")]
    pub speed: Option<PathBuf>,
    /// Play at recorded speed and drop what is late, instead of lock-step.
    #[arg(long, conflicts_with_all = ["deterministic", "iterations"])]
    pub live: bool,
    /// With --live: this many times the recorded speed.
    #[arg(long, default_value_t = 1.0, requires = "live", value_name = "R", value_parser = parse_rate)]
    pub rate: f64,
    /// Lock-step: every frame is processed, with a fixed number of mapping iterations per keyframe. The default.
    #[arg(long)]
    pub deterministic: bool,
    /// Mapping iterations per keyframe in lock-step.
    #[arg(long, default_value_t = DEFAULT_ITERATIONS, value_name = "N")]
    pub iterations: u32,
    /// Leave out this many frames at the beginning.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub start: u64,
    /// Play at most this many frames.
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// Play this many one-way passes, to and fro, with ten standing frames at each turn.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub ping_pong: u64,
    /// Map with these poses (KITTI's format, one line per image) instead of the tracked ones; the tracker still
    /// chooses the keyframes. For telling errors of mapping from errors of tracking.
    #[arg(long, value_name = "FILE")]
    pub poses: Option<PathBuf>,
    /// What is done to the frames.
    #[command(flatten)]
    pub degrade: DegradeArgs,
    /// The map to go on with.
    #[command(flatten)]
    pub resume: ResumeArgs,
    /// What all tracking commands share.
    #[command(flatten)]
    pub common: CommonArgs,
}

/// Runs the command.
///
/// # Errors
/// [`RunError`].
pub fn run(args: &ReplayArgs) -> Result<(), RunError> {
    let description = kilogs_camera::source::describe(&args.dataset, args.camera.as_deref(), args.fps)
        .map_err(|e| RunError::from(CameraError::from(e)))?;
    let pace = if args.live { Pace::Live } else { Pace::LockStep { iterations: args.iterations } };
    let mut plan = RunPlan::new(&args.common, description.format, pace, &args.out)?;
    plan.resume(&args.resume)?;
    plan.may_reverse = args.ping_pong > 1;
    let range = PlaybackRange { start: args.start, frames: args.frames, passes: args.ping_pong };
    let schedule = Schedule::new(description.images.len() as u64, &range)?;
    plan.n_frames = Some(schedule.n_steps());
    args.degrade.check(plan.n_frames)?;
    // The capture process opens it again; its problems are better told here.
    SpeedFile::of_recording(&args.dataset, args.speed.as_deref(), args.ping_pong)?;
    plan.given_poses = args.poses.as_deref().map(|poses| given_poses(poses, schedule, &description)).transpose()?;
    // The capture process has a list of its own.
    drop(description);
    pipeline::run_with_child(plan, |service| CameraChild::start(camera_arguments(args, service)))
}

/// Where the pose of every frame that the capture process will send is found.
fn given_poses(poses: &Path, schedule: Schedule, description: &CameraDescription) -> Result<GivenPosesPlan, RunError> {
    let n_poses = PoseFile::open(poses).map_err(SceneError::from)?.n_poses();
    let line = |image: u64| line_of(poses, n_poses, &description.images, image as usize);
    // Every pass shows the images of the first.
    let shown = || (0..schedule.pass_length()).map(|step| schedule.frame_index(step));
    let first = schedule.frame_index(0);
    let first_line = line(first)?.checked_sub(first);
    for image in shown() {
        if first_line.map(|first_line| first_line + image) != Some(line(image)?) {
            let name = description.images[image as usize].display();
            let reason =
                format!("the numbers of the images are not consecutive at {name}; give a line for every image");
            return Err(SceneError::file(poses, reason).into());
        }
    }
    let first_line = first_line.unwrap_or_default();
    Ok(GivenPosesPlan { file: poses.to_owned(), schedule, first_line })
}

/// Command line of the capture process.
fn camera_arguments(args: &ReplayArgs, service: &str) -> Vec<String> {
    let mut words = vec!["camera".to_owned(), "folder".to_owned(), args.dataset.display().to_string()];
    let mut option = |name: &str, value: String| words.extend([name.to_owned(), value]);
    option("--service", service.to_owned());
    option("--start", args.start.to_string());
    option("--ping-pong", args.ping_pong.to_string());
    if let Some(camera) = &args.camera {
        option("--camera", camera.clone());
    }
    if let Some(fps) = args.fps {
        option("--fps", fps.to_string());
    }
    if let Some(speed) = &args.speed {
        option("--speed", speed.display().to_string());
    }
    if let Some(frames) = args.frames {
        option("--frames", frames.to_string());
    }
    if args.live {
        option("--rate", args.rate.to_string());
        // A capture process of our own starts with the tracker and ends with it, live or not.
        words.extend(["--live", "--wait-for-tracker", "30", "--end-with-tracker"].map(str::to_owned));
    }
    words.push("--quiet".to_owned());
    words.extend(args.degrade.to_words());
    words
}
