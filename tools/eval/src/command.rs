//! `kilogs eval`: judges an output folder against ground truth and writes `eval.json` there.

use crate::align::Freedom;
use crate::associate::{self, PosePair};
use crate::ate::{Ate, ate};
use crate::rpe::{Rpe, rpe};
use crate::segments::{SegmentErrors, distance_driven_m, segment_errors};
use crate::stdout;
use crate::trajectory::{StampedPose, Truth, read_times, read_truth, read_tum};
use serde::Serialize;
use std::collections::HashMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Arguments of `kilogs eval`.
#[derive(Clone, Debug, clap::Args)]
#[command(
    after_help = "Example: kilogs eval out/04 --gt ../shared/data/kitti04-full/poses.txt\n\nLPIPS is measured where \
                  models/ has a network for it, see models/README.md; all other options are for drawing the map then."
)]
pub struct EvalArgs {
    /// Output folder of a run (trajectory_tum.txt, frames.csv, report.json).
    pub dir: PathBuf,
    /// Ground truth: KITTI poses (line k is image k of the data set) or a TUM trajectory.
    #[arg(long, value_name = "POSES")]
    pub gt: PathBuf,
    /// Data set whose times.txt says when each image was taken; default: the folder of the ground truth.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
}

/// Why an output folder could not be judged.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// A file is not there or cannot be read; check the path and that the run finished.
    #[error("reading {path}: {source}; is this the right path, and did the run finish?")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A line of a file is not what the format asks for.
    #[error("reading {path}: line {line} {problem}")]
    Malformed {
        /// The file.
        path: PathBuf,
        /// Line, counted from 1.
        line: usize,
        /// What is wrong with it.
        problem: String,
    },
    /// No pose of the run has a counterpart in the truth: most likely files of different recordings.
    #[error(
        "judging {run} against {truth}: none of {estimated} poses belongs to any of {known} true ones; \
         is this the truth of the recording that was run? (--dataset names the folder whose times.txt fits)"
    )]
    NothingInCommon {
        /// The run's trajectory.
        run: PathBuf,
        /// The truth.
        truth: PathBuf,
        /// Poses in the run.
        estimated: usize,
        /// Poses in the truth.
        known: usize,
    },
    /// The truth and the data set's times are of different recordings; name the folder that fits.
    #[error(
        "judging against {truth}: it has {n_poses} poses, but {times} has {n_times} times; \
         name the folder whose times.txt fits with --dataset"
    )]
    OtherTimes {
        /// The times.
        times: PathBuf,
        /// The truth.
        truth: PathBuf,
        /// Lines of the times.
        n_times: usize,
        /// Lines of the truth.
        n_poses: usize,
    },
    /// `eval.json` could not be written; check space and permissions of the folder.
    #[error("writing {path}: {source}; check free space and permissions of the folder")]
    Unwritable {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// `eval.json`: figures only, null where not measurable.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct EvalFile {
    /// ATE RMSE after Sim(3) alignment, m.
    pub ate_sim3_m: Option<f64>,
    /// ATE RMSE after SE(3) alignment, m.
    pub ate_se3_m: Option<f64>,
    /// Factor from the run's lengths to the true ones (Sim(3) alignment).
    pub scale: Option<f64>,
    /// KITTI segment error, %.
    pub segment_translation_percent: Option<f64>,
    /// KITTI segment error, degrees per 100 m.
    pub segment_rotation_deg_per_100m: Option<f64>,
    /// RMSE of the rotation from frame to frame, degrees.
    pub rpe_rotation_deg: Option<f64>,
    /// RMSE of the translation from frame to frame, m.
    pub rpe_translation_m: Option<f64>,
    /// From the run's report: training keyframes.
    pub psnr_train_db: Option<f64>,
    /// From the run's report: frames that mapping never saw.
    pub psnr_heldout_db: Option<f64>,
    /// From the run's report: training keyframes.
    pub ssim_train: Option<f64>,
    /// From the run's report: frames that mapping never saw.
    pub ssim_heldout: Option<f64>,
    /// LPIPS of the training keyframes: [`LpipsFigures::train`].
    pub lpips_train: Option<f64>,
    /// LPIPS of frames that mapping never saw: [`LpipsFigures::held_out`].
    pub lpips_heldout: Option<f64>,
}

/// How different the map looks from the camera's images to a network; 0 is alike. Unknown where none is installed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LpipsFigures {
    /// Mean over the training keyframes.
    pub train: Option<f64>,
    /// Mean over the frames that mapping never saw.
    pub held_out: Option<f64>,
}

/// Everything that was found out about a run.
#[derive(Clone, Debug)]
pub struct Judgement {
    /// Poses in the run's trajectory.
    pub n_estimated: usize,
    /// Poses that have a counterpart in the truth.
    pub n_judged: usize,
    /// True length of the judged path, m.
    pub path_length_m: f64,
    /// How the poses were matched to the truth, for people.
    pub matched_by: String,
    /// All frames after Sim(3) alignment.
    pub ate_sim3: Option<Ate>,
    /// All frames after SE(3) alignment.
    pub ate_se3: Option<Ate>,
    /// Keyframes only, after Sim(3) alignment.
    pub keyframe_ate_sim3: Option<Ate>,
    /// Drift over 100 to 800 m.
    pub segments: Option<SegmentErrors>,
    /// Error from frame to frame.
    pub rpe: Option<Rpe>,
    /// What goes to disk.
    pub file: EvalFile,
}

/// Judges the folder, writes `eval.json` and prints a table on stdout. `measure_lpips` is asked once all else is known, for
/// it takes its time.
///
/// # Errors
/// [`EvalError`] when a file is missing or wrong, or nothing can be compared.
pub fn run(args: &EvalArgs, measure_lpips: impl FnOnce() -> LpipsFigures) -> Result<(), EvalError> {
    let mut judgement = judge(&args.dir, &args.gt, args.dataset.as_deref())?;
    let lpips = measure_lpips();
    (judgement.file.lpips_train, judgement.file.lpips_heldout) = (lpips.train, lpips.held_out);
    let path = args.dir.join("eval.json");
    let written = crate::replace_json(&path, &judgement.file);
    written.map_err(|source| EvalError::Unwritable { path: path.clone(), source })?;
    let text = format!("{}written: {}\n", judgement.table(), path.display());
    stdout::show(&text).map_err(|source| EvalError::Unwritable { path: "standard output".into(), source })
}

/// Judges the folder without writing anything.
///
/// # Errors
/// [`EvalError`] when a file is missing or wrong, or nothing can be compared.
pub fn judge(dir: &Path, gt: &Path, dataset: Option<&Path>) -> Result<Judgement, EvalError> {
    let trajectory = dir.join("trajectory_tum.txt");
    let estimate = read_tum(&trajectory)?;
    let (truth, matched_by) = stamped_truth(dir, gt, dataset)?;
    let pairs = associate::by_time(&estimate, &truth);
    if pairs.is_empty() {
        return Err(EvalError::NothingInCommon {
            run: trajectory,
            truth: gt.to_owned(),
            estimated: estimate.len(),
            known: truth.len(),
        });
    }
    let keyframes = dir.join("keyframes_tum.txt");
    let keyframes = if keyframes.exists() { read_tum(&keyframes)? } else { Vec::new() };
    let mut judgement = figures(&pairs);
    judgement.n_estimated = estimate.len();
    judgement.matched_by = matched_by;
    judgement.keyframe_ate_sim3 = ate(&associate::by_time(&keyframes, &truth), Freedom::Sim3);
    judgement.file = image_figures(dir, judgement.file)?;
    Ok(judgement)
}

fn figures(pairs: &[PosePair]) -> Judgement {
    let (ate_sim3, ate_se3) = (ate(pairs, Freedom::Sim3), ate(pairs, Freedom::Se3));
    let (segments, rpe) = (segment_errors(pairs), rpe(pairs, 1));
    Judgement {
        n_estimated: pairs.len(),
        n_judged: pairs.len(),
        path_length_m: distance_driven_m(pairs).last().copied().unwrap_or(0.0),
        matched_by: String::new(),
        ate_sim3,
        ate_se3,
        keyframe_ate_sim3: None,
        segments,
        rpe,
        file: EvalFile {
            ate_sim3_m: ate_sim3.map(|ate| ate.rmse_m),
            ate_se3_m: ate_se3.map(|ate| ate.rmse_m),
            scale: ate_sim3.map(|ate| ate.alignment.scale),
            segment_translation_percent: segments.map(|s| s.translation_percent),
            segment_rotation_deg_per_100m: segments.map(|s| s.rotation_deg_per_100m),
            rpe_rotation_deg: rpe.map(|rpe| rpe.rotation_rmse_deg),
            rpe_translation_m: rpe.map(|rpe| rpe.translation_rmse_m),
            ..EvalFile::default()
        },
    }
}

/// The truth with times on the run's clock, and how they were found.
///
/// KITTI truth has no times: they come from the data set's `times.txt`, else from the run's own `frames.csv`,
/// whose frame k is then taken to be image k.
fn stamped_truth(dir: &Path, gt: &Path, dataset: Option<&Path>) -> Result<(Vec<StampedPose>, String), EvalError> {
    let poses = match read_truth(gt)? {
        Truth::Stamped(poses) => return Ok((poses, format!("times of {}", gt.display()))),
        Truth::PerImage(poses) => poses,
    };
    let folder = dataset.or(gt.parent()).unwrap_or(Path::new(""));
    let times_file = folder.join("times.txt");
    if dataset.is_some() || times_file.exists() {
        let times_s = read_times(&times_file)?;
        if times_s.len() != poses.len() {
            let (n_times, n_poses) = (times_s.len(), poses.len());
            return Err(EvalError::OtherTimes { times: times_file, truth: gt.to_owned(), n_times, n_poses });
        }
        let stamp = |(&time_s, &world_from_camera)| StampedPose { time_s, world_from_camera };
        let stamped = times_s.iter().zip(&poses).map(stamp).collect();
        return Ok((stamped, format!("times of {}", times_file.display())));
    }
    let frames_csv = dir.join("frames.csv");
    let time_of_frame = read_frame_times(&frames_csv)?;
    let stamp =
        |(k, &world_from_camera)| time_of_frame.get(&k).map(|&time_s| StampedPose { time_s, world_from_camera });
    let stamped = poses.iter().enumerate().filter_map(stamp).collect();
    Ok((stamped, format!("index in {}: run from image 0 (else name --dataset)", frames_csv.display())))
}

/// Times of the frames by their index, from the first two columns of `frames.csv`.
fn read_frame_times(path: &Path) -> Result<HashMap<usize, f64>, EvalError> {
    let text =
        std::fs::read_to_string(path).map_err(|source| EvalError::Unreadable { path: path.to_owned(), source })?;
    let mut time_of_frame = HashMap::new();
    for (line, row) in text.lines().enumerate().skip(1) {
        let mut columns = row.split(',');
        let (index, time) = (columns.next().unwrap_or(""), columns.next().unwrap_or(""));
        if time.is_empty() {
            continue; // Dropped before its time was known.
        }
        let (Ok(index), Ok(time_s)) = (index.parse(), time.parse()) else {
            let problem = "does not begin with an index and a time".to_owned();
            return Err(EvalError::Malformed { path: path.to_owned(), line: line + 1, problem });
        };
        time_of_frame.insert(index, time_s);
    }
    Ok(time_of_frame)
}

/// Adds what the run's report says about images; a folder without a report has none.
fn image_figures(dir: &Path, file: EvalFile) -> Result<EvalFile, EvalError> {
    let path = dir.join("report.json");
    if !path.exists() {
        return Ok(file);
    }
    let text = std::fs::read_to_string(&path).map_err(|source| EvalError::Unreadable { path: path.clone(), source })?;
    let report: serde_json::Value = serde_json::from_str(&text).map_err(|error| EvalError::Malformed {
        path,
        line: error.line(),
        problem: format!("is not JSON: {error}"),
    })?;
    let figure = |key: &str| report["mapping"][key].as_f64();
    Ok(EvalFile {
        psnr_train_db: figure("psnr_train_db"),
        psnr_heldout_db: figure("psnr_heldout_db"),
        ssim_train: figure("ssim_train"),
        ssim_heldout: figure("ssim_heldout"),
        ..file
    })
}

impl Judgement {
    /// The figures for people.
    pub fn table(&self) -> String {
        let mut table = format!(
            "{} of {} poses judged over {:.1} m, matched by {}\n",
            self.n_judged, self.n_estimated, self.path_length_m, self.matched_by
        );
        let mut row = |name: &str, value: Option<f64>, unit: &str| {
            let value = value.filter(|v| v.is_finite()).map_or_else(|| "-".to_owned(), |v| format!("{v:.4}"));
            let _ = writeln!(table, "  {name:<34}{value:>12} {unit}");
        };
        let percent = |ate: Option<Ate>| ate.map(|a| 100.0 * a.rmse_m / self.path_length_m);
        row("ATE RMSE, Sim(3) aligned", self.file.ate_sim3_m, "m");
        row("  largest", self.ate_sim3.map(|ate| ate.max_m), "m");
        row("  keyframes only", self.keyframe_ate_sim3.map(|ate| ate.rmse_m), "m");
        row("ATE RMSE, SE(3) aligned", self.file.ate_se3_m, "m");
        row("  of the length driven", percent(self.ate_se3), "%");
        row("scale (true / estimated)", self.file.scale, "");
        row("KITTI segments, translation", self.file.segment_translation_percent, "%");
        row("KITTI segments, rotation", self.file.segment_rotation_deg_per_100m, "deg/100 m");
        row("frame to frame RMSE, translation", self.file.rpe_translation_m, "m");
        row("frame to frame RMSE, rotation", self.file.rpe_rotation_deg, "deg");
        row("PSNR training keyframes", self.file.psnr_train_db, "dB");
        row("PSNR held-out frames", self.file.psnr_heldout_db, "dB");
        row("SSIM training keyframes", self.file.ssim_train, "");
        row("SSIM held-out frames", self.file.ssim_heldout, "");
        row("LPIPS training keyframes", self.file.lpips_train, "");
        row("LPIPS held-out frames", self.file.lpips_heldout, "");
        table
    }
}
