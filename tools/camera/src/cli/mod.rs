//! The command line of the capture process; `kilogs` runs it in a child of its own.

mod words;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};

use crate::camera_file::CameraArgument;
use crate::ipc::{FrameSlots, Speed, parse_service};
use crate::publish::{Pace, PublishError, PublishSettings, publish};
use crate::sim::{SimArgs, SimError, Simulator, TruthRecorder, write_dataset};
use crate::source::{
    DegradeArgs, Degraded, FolderSource, FrameSource, Playback, PlaybackRange, SourceError, SpeedFile, WithSpeed,
};

/// How long a lock-step run waits for its tracker.
const TRACKER_PATIENCE_S: f64 = 30.0;

/// Publishes camera frames over iceoryx2: a recorded folder or a simulated street.
#[derive(Clone, Debug, Parser)]
#[command(
    name = "kilogs-camera",
    version,
    after_help = "Examples:\n  kilogs-camera folder ../shared/data/kitti04-full --camera kitti --service front --live\n  \
                  kilogs-camera sim --seed 3 --length 500 --service front --live\n  \
                  kilogs-camera sim --start 100 --frames 50 --write drive\n  \
                  kilogs-camera sim --degrade tunnel@50..80 --degrade rain@60..120 --write dark"
)]
pub struct CameraArgs {
    /// Where the frames come from.
    #[command(subcommand)]
    pub source: SourceArgs,
}

/// Where the frames come from.
#[derive(Clone, Debug, Subcommand)]
pub enum SourceArgs {
    /// A recorded folder in the layout of KITTI odometry.
    #[command(
        after_help = "Examples:\n  kilogs-camera folder ../shared/data/kitti04-full --camera kitti --service front --live\n  \
                      kilogs-camera folder ../shared/data/kitti04-full --camera kitti --start 50 --frames 100\n  \
                      kilogs-camera folder ../shared/data/kitti04-full --camera kitti --degrade gap@100..110"
    )]
    Folder(FolderArgs),
    /// A simulated street.
    #[command(
        after_help = "Examples:\n  kilogs-camera sim --seed 3 --length 500 --service front --live --truth truth\n  \
                            kilogs-camera sim --start 100 --frames 50 --write drive\n  \
                            kilogs-camera sim --degrade tunnel@50..80 --write dark\n  \
                            kilogs-camera sim --drive pure-rotation --length 120 --write turn"
    )]
    Sim(SimulationArgs),
}

/// Arguments of `sim`.
#[derive(Clone, Debug, Args)]
pub struct SimulationArgs {
    /// What is simulated.
    #[command(flatten)]
    pub sim: SimArgs,
    /// Write the truth beside publishing: poses, times, calibration, depth, in KITTI's layout.
    #[arg(long, value_name = "DIR")]
    pub truth: Option<PathBuf>,
    /// Write the whole drive, images and truth, as a recorded folder, and publish nothing.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["truth", "live", "service"])]
    pub write: Option<PathBuf>,
    /// What is done to the frames.
    #[command(flatten)]
    pub degrade: DegradeArgs,
    /// How it is published.
    #[command(flatten)]
    pub publish: PublishArgs,
}

/// Arguments of `folder`.
#[derive(Clone, Debug, Args)]
pub struct FolderArgs {
    /// Folder with image_0, image_2 or images, calib.txt and times.txt.
    pub dataset: PathBuf,
    /// camera.toml, or the preset `kitti` (1.65 m over the road, axes aligned; intrinsics from the data set).
    #[arg(long, value_name = "FILE|kitti")]
    pub camera: Option<String>,
    /// Frames per second; needed where times.txt is missing, and used instead of it where given.
    #[arg(long)]
    pub fps: Option<f64>,
    /// Wheel speed, `t_seconds metres_per_second sigma` on a line, on the clock of the frames; the default is speed.txt in
    /// the folder, where there is one.
    #[arg(long, value_name = "FILE")]
    pub speed: Option<PathBuf>,
    /// Which part is played.
    #[command(flatten)]
    pub range: RangeArgs,
    /// What is done to the frames.
    #[command(flatten)]
    pub degrade: DegradeArgs,
    /// How it is published.
    #[command(flatten)]
    pub publish: PublishArgs,
}

/// Which part of a recording is played.
#[derive(Clone, Copy, Debug, Args)]
pub struct RangeArgs {
    /// Leave out this many frames at the beginning.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub start: u64,
    /// Play at most this many frames.
    #[arg(long, value_name = "N")]
    pub frames: Option<u64>,
    /// Play this many one-way passes, to and fro, with ten standing frames at each turn.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub ping_pong: u64,
}

/// How frames are published.
#[derive(Clone, Debug, Args)]
pub struct PublishArgs {
    /// Service name; a tracker attaches with `kilogs run --service NAME`.
    #[arg(long, default_value = "front", value_name = "NAME", value_parser = parse_service)]
    pub service: String,
    /// Play at the recorded speed, whether the tracker keeps up or not. Otherwise each frame waits for the tracker.
    #[arg(long)]
    pub live: bool,
    /// With --live: this many times the recorded speed.
    #[arg(long, default_value_t = 1.0, requires = "live", value_name = "R", value_parser = parse_rate)]
    pub rate: f64,
    /// Wait this many seconds for a tracker before the first frame [default: 30; with --live: do not wait].
    #[arg(long, value_name = "S", value_parser = parse_seconds)]
    pub wait_for_tracker: Option<f64>,
    /// With --live: end when the tracker does, instead of playing on for the next one.
    #[arg(long, requires = "live")]
    pub end_with_tracker: bool,
    /// Which camera of the vehicle.
    #[arg(long, default_value_t = 0, value_name = "N")]
    pub camera_id: u32,
    /// Show no progress bar.
    #[arg(long)]
    pub quiet: bool,
}

/// Why the capture process failed.
#[derive(Debug, thiserror::Error)]
pub enum CameraError {
    /// The source could not be opened.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The drive cannot be simulated.
    #[error(transparent)]
    Simulation(#[from] SimError),
    /// Publishing ended early.
    #[error(transparent)]
    Publish(#[from] PublishError),
    /// Ctrl-C could not be taken over.
    #[error("taking over Ctrl-C: {0}; is another handler installed?")]
    Signals(#[from] ctrlc::Error),
}

impl CameraError {
    /// Exit code: 1 when the run failed, 2 when the configuration is wrong, 3 when the input is.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Source(SourceError::File { .. })
            | Self::Simulation(SimError::Path { .. })
            | Self::Publish(PublishError::NothingReadable { .. }) => 3,
            Self::Source(SourceError::Camera { .. } | SourceError::Range(_) | SourceError::LeftOut { .. })
            | Self::Simulation(SimError::Range { .. } | SimError::Degrade(_)) => 2,
            Self::Simulation(SimError::Truth { .. }) | Self::Publish(_) | Self::Signals(_) => 1,
        }
    }
}

impl RangeArgs {
    /// The part as the source understands it.
    pub fn range(&self) -> PlaybackRange {
        PlaybackRange { start: self.start, frames: self.frames, passes: self.ping_pong }
    }
}

impl PublishArgs {
    fn settings(&self) -> PublishSettings {
        let pace = if self.live { Pace::Live { rate: self.rate } } else { Pace::LockStep };
        let patience_s = self.wait_for_tracker.or((!self.live).then_some(TRACKER_PATIENCE_S));
        PublishSettings {
            service: self.service.clone(),
            pace,
            tracker_patience: patience_s.map(Duration::from_secs_f64),
            ends_with_tracker: self.end_with_tracker,
            slots: FrameSlots::DEFAULT,
            camera_id: self.camera_id,
        }
    }
}

/// Runs the capture process until its source ends or Ctrl-C is pressed.
///
/// # Errors
/// [`CameraError`], with the exit code in it.
pub fn run(args: &CameraArgs) -> Result<(), CameraError> {
    match &args.source {
        SourceArgs::Folder(folder) => {
            let camera = folder.camera.as_deref().map(CameraArgument::from);
            let frames = FolderSource::open(&folder.dataset, camera.as_ref(), folder.fps)?;
            let played = Playback::new(frames, &folder.range.range())?;
            let degraded = Degraded::new(played, &folder.degrade)?;
            let readings = SpeedFile::of_recording(&folder.dataset, folder.speed.as_deref(), folder.range.ping_pong)?;
            let readings = readings.map(|file| Box::new(file) as Box<dyn Iterator<Item = Speed>>);
            run_source(&mut WithSpeed::new(degraded, readings), &folder.publish)
        }
        SourceArgs::Sim(simulation) => run_simulation(simulation),
    }
}

fn run_simulation(args: &SimulationArgs) -> Result<(), CameraError> {
    if let Some(folder) = &args.write {
        let bar = progress_bar(None, args.publish.quiet);
        write_dataset(&args.sim, &args.degrade, folder, |done, all| {
            bar.set_length(all as u64);
            bar.set_position(done as u64);
        })?;
        bar.finish_and_clear();
        return Ok(());
    }
    let simulator = Simulator::new(&args.sim)?;
    let readings =
        args.sim.speed_noise.map(|sigma| Box::new(simulator.speeds(sigma)) as Box<dyn Iterator<Item = Speed>>);
    match &args.truth {
        Some(folder) => {
            let recorded = Degraded::new(TruthRecorder::create(folder, simulator)?, &args.degrade)?;
            let mut source = WithSpeed::new(recorded, readings);
            run_source(&mut source, &args.publish)?;
            Ok(source.into_source().into_source().finish()?)
        }
        None => {
            let degraded = Degraded::new(simulator, &args.degrade)?;
            run_source(&mut WithSpeed::new(degraded, readings), &args.publish)
        }
    }
}

fn run_source(source: &mut dyn FrameSource, args: &PublishArgs) -> Result<(), CameraError> {
    let stop = Arc::new(AtomicBool::new(false));
    let stop_on_signal = Arc::clone(&stop);
    ctrlc::set_handler(move || stop_on_signal.store(true, Ordering::Relaxed))?;
    let bar = progress_bar(source.format().n_frames, args.quiet);
    let report = publish(source, &args.settings(), &stop, &mut |sequence| bar.set_position(sequence + 1))?;
    bar.finish_and_clear();
    log::info!(
        "{} frames sent, {} left out because they could not be read{}",
        report.n_sent,
        report.n_unreadable,
        if report.is_interrupted { ", interrupted" } else { "" }
    );
    Ok(())
}

fn progress_bar(n_frames: Option<u64>, is_quiet: bool) -> ProgressBar {
    let bar = match n_frames {
        _ if is_quiet => ProgressBar::hidden(),
        Some(n_frames) => ProgressBar::new(n_frames),
        None => ProgressBar::new_spinner(),
    };
    match ProgressStyle::with_template("{bar:40} {pos}/{len} frames, {per_sec}, {eta} left") {
        Ok(style) => bar.with_style(style),
        Err(_) => bar,
    }
}

/// A playback rate as typed.
///
/// # Errors
/// What to type instead.
pub fn parse_rate(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(rate) if rate.is_finite() && rate > 0.0 => Ok(rate),
        _ => Err("give a number above 0, for example 2".to_owned()),
    }
}

fn parse_seconds(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..1e6).contains(&seconds) => Ok(seconds),
        _ => Err("give a number of seconds from 0 on".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    fn settings(words: &[&str]) -> Result<PublishSettings, String> {
        let args = CameraArgs::try_parse_from(["kilogs-camera", "folder", "data"].iter().chain(words));
        match args.map_err(|e| e.to_string())?.source {
            SourceArgs::Folder(FolderArgs { publish, .. }) | SourceArgs::Sim(SimulationArgs { publish, .. }) => {
                Ok(publish.settings())
            }
        }
    }

    #[test]
    fn the_command_line_holds_together() {
        CameraArgs::command().debug_assert();
        let lock_step = settings(&[]).expect("defaults");
        assert_eq!((lock_step.pace, lock_step.tracker_patience), (Pace::LockStep, Some(Duration::from_secs(30))));
        let live = settings(&["--live", "--rate", "2.5"]).expect("live");
        assert_eq!((live.pace, live.tracker_patience), (Pace::Live { rate: 2.5 }, None));
        for bad in [
            &["--service", ""][..],
            &["--service", "bad name!"],
            &["--rate", "2"],
            &["--live", "--rate", "0"],
            &["--live", "--rate", "NaN"],
            &["--ping-pong", "0"],
        ] {
            assert!(settings(bad).is_err(), "{bad:?}");
        }
    }

    #[test]
    fn every_help_has_an_example() {
        let mut command = CameraArgs::command();
        let mut helps = vec![command.render_long_help().to_string()];
        let own = command.get_subcommands_mut().filter(|c| c.get_name() != "help");
        helps.extend(own.map(|c| c.render_long_help().to_string()));
        for help in helps {
            let examples = help.lines().filter_map(|line| Some(line.trim().split_once("kilogs-camera ")?.1));
            let examples: Vec<&str> = examples.filter(|words| !words.contains(['<', '['])).collect();
            assert!(!examples.is_empty(), "{help}");
            for words in examples {
                let parsed = CameraArgs::try_parse_from(["kilogs-camera"].into_iter().chain(words.split(' ')));
                assert!(parsed.is_ok(), "{words}: {parsed:?}");
            }
        }
    }
}
