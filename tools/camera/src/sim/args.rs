//! What is simulated, as typed, and why it cannot be.

use super::drive_kind::DriveKind;
use crate::source::SourceError;
use std::path::PathBuf;

/// What to simulate.
#[derive(clap::Args, Clone, Debug)]
pub struct SimArgs {
    /// Seed of the town's look and, without --path, of the way.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Drive along these KITTI poses (one frame per pose, laid flat) instead of a generated way.
    #[arg(long, value_name = "POSES")]
    pub path: Option<PathBuf>,
    /// How a generated drive goes: `street`, `pure-rotation` (stops, turns on the spot and back), `standing-then-go`,
    /// `planar-road` or `planar-wall` (nothing but one plane to see, from a third of the way on).
    #[arg(long, value_enum, default_value_t = DriveKind::Street, conflicts_with = "path", hide_possible_values = true)]
    pub drive: DriveKind,
    /// Length of a generated drive, m.
    #[arg(long, default_value_t = 320.0, value_name = "METRES", value_parser = parse_length)]
    pub length: f64,
    /// Leave out this many frames at the beginning of the drive; times and town stay as they are.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub start: u64,
    /// Deliver at most this many frames.
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// Image width, px.
    #[arg(long, default_value_t = 620, value_parser = clap::value_parser!(u32).range(32..=4096))]
    pub width: u32,
    /// Image height, px.
    #[arg(long, default_value_t = 188, value_parser = clap::value_parser!(u32).range(32..=4096))]
    pub height: u32,
    /// Frames per second.
    #[arg(long, default_value_t = 10.0, value_parser = positive)]
    pub fps: f64,
    /// Publish grey images instead of colour.
    #[arg(long)]
    pub mono: bool,
    /// Standard deviation of the sensor's noise, in steps of 8 bits.
    #[arg(long, default_value_t = 1.0, value_parser = not_negative)]
    pub noise: f64,
    /// Tell the vehicle's speed too, with noise of this standard deviation, m/s; 0 tells the truth.
    #[arg(long, value_name = "SIGMA", value_parser = not_negative)]
    pub speed_noise: Option<f64>,
}

/// Settings for tests and for the demo: `SimArgs` as if nothing had been typed.
impl Default for SimArgs {
    fn default() -> Self {
        Self {
            seed: 1,
            path: None,
            drive: DriveKind::Street,
            length: 320.0,
            start: 0,
            frames: None,
            width: 620,
            height: 188,
            fps: 10.0,
            mono: false,
            noise: 1.0,
            speed_noise: None,
        }
    }
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value > 0.0 => Ok(value),
        _ => Err(format!("\"{text}\" is not a number above 0")),
    }
}

/// Reads the length of a drive, m: what is laid out before the first frame has to have an end.
///
/// # Errors
/// What is wrong with it.
pub fn parse_length(text: &str) -> Result<f64, String> {
    const LONGEST_M: f64 = 100_000.0;
    match positive(text)? {
        length_m if length_m <= LONGEST_M => Ok(length_m),
        length_m => Err(format!("{length_m} m is more than the longest drive, {LONGEST_M} m")),
    }
}

fn not_negative(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() && value >= 0.0 => Ok(value),
        _ => Err(format!("\"{text}\" is not a number of at least 0")),
    }
}

/// Why a drive cannot be simulated or its truth not be written.
#[derive(Debug, thiserror::Error)]
pub enum SimError {
    /// The file with the way is unreadable or no KITTI pose file.
    #[error("reading the way from {path}: {reason}; expected KITTI poses, 12 numbers a line")]
    Path {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// No frame is left of the drive.
    #[error(
        "simulating: --start {start} --frames {} of a drive of {n_frames} frames leaves none; start below {n_frames} and \
         ask for at least one frame, or drive longer with --length",
        .frames.map_or("all".to_owned(), |n| n.to_string())
    )]
    Range {
        /// Frames to leave out.
        start: u64,
        /// Frames to deliver at most.
        frames: Option<u64>,
        /// Frames of the drive.
        n_frames: u64,
    },
    /// Frames cannot be spoilt as asked.
    #[error(transparent)]
    Degrade(#[from] SourceError),
    /// The truth could not be written.
    #[error(
        "writing the simulator's truth to {path}: {reason}; check free space and permissions, or name another folder"
    )]
    Truth {
        /// The file.
        path: PathBuf,
        /// What went wrong.
        reason: String,
    },
}
