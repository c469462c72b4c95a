//! `kilogs replay`: a recorded sequence through a capture process of its own.

use super::CommonArgs;
use crate::fit::poses_of;
use crate::input::CameraChild;
use crate::pipeline::{self, GivenPoses, Pace, RunPlan};
use crate::run_error::RunError;
use kilogs_camera::cli::{CameraError, parse_rate};
use kilogs_camera::source::{CameraDescription, PlaybackRange, Schedule};
use std::path::{Path, PathBuf};

/// Mapping iterations per keyframe in lock-step, unless told otherwise.
pub const DEFAULT_ITERATIONS: u32 = 20;

/// Options of `kilogs replay`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Examples:\n  kilogs replay ../shared/data/kitti04-full --camera kitti --out out/04\n  \
    kilogs replay DATASET --camera camera.toml --live --rate 0.5 --out out/live\n  \
    kilogs replay DATASET --camera kitti --poses DATASET/poses.txt --out out/given")]
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
    plan.may_reverse = args.ping_pong > 1;
    let range = PlaybackRange { start: args.start, frames: args.frames, passes: args.ping_pong };
    let schedule = Schedule::new(description.images.len() as u64, &range)?;
    plan.n_frames = Some(schedule.n_steps());
    plan.given_poses = args.poses.as_deref().map(|poses| given_poses(poses, &schedule, &description)).transpose()?;
    pipeline::run_with_child(plan, |service| CameraChild::start(camera_arguments(args, service)))
}

/// The pose of every frame that the capture process will send.
fn given_poses(poses: &Path, schedule: &Schedule, description: &CameraDescription) -> Result<GivenPoses, RunError> {
    let images: Vec<usize> = (0..schedule.n_steps()).map(|step| schedule.frame_index(step) as usize).collect();
    let n_needed = images.iter().max().map_or(0, |last| last + 1);
    let world_from_camera = poses_of(poses, &description.images, n_needed)?;
    Ok(GivenPoses::new(images.iter().filter_map(|&image| world_from_camera.get(image).copied()).collect()))
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
    if let Some(frames) = args.frames {
        option("--frames", frames.to_string());
    }
    if args.live {
        option("--rate", args.rate.to_string());
        // A capture process of our own starts with the tracker and ends with it, live or not.
        words.extend(["--live", "--wait-for-tracker", "30", "--end-with-tracker"].map(str::to_owned));
    }
    words.push("--quiet".to_owned());
    words
}
