//! `kilogs run`: attaches to a camera that is already there.

use super::{CommonArgs, ResumeArgs};
use crate::pipeline::{self, Pace, RunPlan};
use crate::run_error::RunError;
use kilogs_camera::camera_file::CameraFile;
use kilogs_camera::source::{PixelFormat, SourceFormat};
use std::path::PathBuf;

/// Options of `kilogs run`.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Example:\n  kilogs-camera folder DATASET --camera kitti --service front --live &\n  \
    kilogs run --service front --camera DATASET/camera.toml --out out/run")]
pub struct RunArgs {
    /// Name of the camera's service.
    #[arg(long, value_name = "NAME", value_parser = kilogs_camera::ipc::parse_service)]
    pub service: String,
    /// camera.toml with size, intrinsics and mounting.
    #[arg(long, value_name = "FILE")]
    pub camera: PathBuf,
    /// Folder for all outputs.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
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
pub fn run(args: &RunArgs) -> Result<(), RunError> {
    if args.camera.as_os_str() == "kitti" {
        return Err(RunError::Usage(
            "setting up the camera: `kitti` says nothing of size and intrinsics, which a recording has and a live camera \
             has not; give --camera a camera.toml with width, height, fx, fy, cx, cy and height_m"
                .to_owned(),
        ));
    }
    let described = CameraFile::read(&args.camera).and_then(|file| file.complete());
    let (camera, mounting) = described.map_err(|e| RunError::Usage(e.to_string()))?;
    // Nobody knows what a live camera will send before its first frame: color is the larger plan.
    let format = SourceFormat { camera, mounting, pixel_format: PixelFormat::Rgb8, n_frames: None };
    let mut plan = RunPlan::new(&args.common, format, Pace::Live, &args.out)?;
    plan.resume(&args.resume)?;
    pipeline::run_attached(plan, &args.service)
}
