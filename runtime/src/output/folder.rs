//! The output folder while a run goes on.

use super::frame_log::{FrameLog, RelativePose};
use super::keyframe_table::{KeyframeTable, PlacedKeyframe};
use super::sink::TextSink;
use super::trajectory::{self, TrajectorySummary};
use super::{OutputError, StageTimes, frame_row};
use kilogs_core::conventions::{Rigid, Similarity, TimestampNs};
use kilogs_core::tracking::{FrameReport, FrameStatus};
use std::path::{Path, PathBuf};

/// Frames by what became of them; `received = tracked + doubtful + lost + dropped`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FrameCounts {
    /// With a verified pose.
    pub tracked: u64,
    /// Tracked frames that became keyframes.
    pub keyframes: u64,
    /// With a predicted pose.
    pub doubtful: u64,
    /// Without a pose.
    pub lost: u64,
    /// Never reached the tracker.
    pub dropped: u64,
}

impl FrameCounts {
    /// All frames.
    pub fn received(&self) -> u64 {
        self.tracked + self.doubtful + self.lost + self.dropped
    }
}

/// Writes the files that grow with the drive. Takes about 300 kB at the start and nothing per frame.
#[derive(Debug)]
pub struct OutputFolder {
    dir: PathBuf,
    frames_csv: TextSink,
    odometry: TextSink,
    frame_log: FrameLog,
    keyframes: KeyframeTable,
    counts: FrameCounts,
    map_from_odometry: Rigid,
}

impl OutputFolder {
    /// Makes the folder, if it is not there, and opens its files; files of an earlier run are replaced. The trajectories
    /// are in the map, the odometry is not.
    ///
    /// # Errors
    /// [`OutputError`] when the folder or a file cannot be made.
    pub fn create(dir: &Path, map_from_odometry: &Rigid) -> Result<Self, OutputError> {
        std::fs::create_dir_all(dir).map_err(|source| OutputError::Folder { path: dir.to_owned(), source })?;
        remove_earlier_judgements(dir)?;
        let mut frames_csv = TextSink::create(dir.join("frames.csv"))?;
        frame_row::write_header(&mut frames_csv)?;
        Ok(Self {
            frames_csv,
            odometry: TextSink::create(dir.join("odometry_tum.txt"))?,
            frame_log: FrameLog::create(dir.join(".frames.log"))?,
            keyframes: KeyframeTable::create(dir.join(".keyframes.table"))?,
            counts: FrameCounts::default(),
            map_from_odometry: *map_from_odometry,
            dir: dir.to_owned(),
        })
    }

    /// Where the files are.
    pub fn path(&self) -> &Path {
        &self.dir
    }

    /// Frames written so far.
    pub fn counts(&self) -> FrameCounts {
        self.counts
    }

    /// Writes a frame that the tracker has seen; frames come in order.
    ///
    /// # Errors
    /// [`OutputError`] when the disk does not take it.
    pub fn frame(&mut self, frame: &FrameReport, times: &StageTimes) -> Result<(), OutputError> {
        match frame.status {
            FrameStatus::Tracked => self.counts.tracked += 1,
            FrameStatus::Doubtful => self.counts.doubtful += 1,
            FrameStatus::Lost => self.counts.lost += 1,
        }
        frame_row::write_frame(&mut self.frames_csv, frame, times)?;
        if frame.status == FrameStatus::Lost {
            return self.frame_log.push(None);
        }
        if frame.is_keyframe {
            let is_tracked = frame.is_tracked_keyframe();
            self.counts.keyframes += u64::from(is_tracked);
            let world_from_keyframe =
                self.map_from_odometry * frame.world_from_camera * frame.keyframe_from_camera.inverse();
            let timestamp_ns = frame.timestamp_ns;
            let placed = PlacedKeyframe { timestamp_ns, is_tracked, world_from_keyframe, scale: 1.0 };
            self.keyframes.place(frame.keyframe_ordinal, &placed)?;
        }
        trajectory::write_tum(&mut self.odometry, frame.timestamp_ns, &frame.world_from_camera)?;
        self.frame_log.push(Some(&RelativePose {
            timestamp_ns: frame.timestamp_ns,
            keyframe_ordinal: frame.keyframe_ordinal,
            keyframe_from_camera: frame.keyframe_from_camera,
        }))
    }

    /// Writes a frame that never reached the tracker; its time may be unknown.
    ///
    /// # Errors
    /// [`OutputError`] when the disk does not take it.
    pub fn dropped(&mut self, frame_index: u64, timestamp_ns: Option<TimestampNs>) -> Result<(), OutputError> {
        self.counts.dropped += 1;
        frame_row::write_dropped(&mut self.frames_csv, frame_index, timestamp_ns)?;
        self.frame_log.push(None)
    }

    /// Moves every keyframe, and the frames that hang on it, as loops ask for: `moved` knows keyframes by their ordinals.
    ///
    /// # Errors
    /// [`OutputError`] when the table cannot be read or written.
    pub fn align(&mut self, moved: impl Fn(u32) -> Similarity) -> Result<(), OutputError> {
        for ordinal in 0..self.keyframes.len() {
            let Some(before) = self.keyframes.get(ordinal)? else { continue };
            let aligned = moved(ordinal) * Similarity::from_isometry(before.world_from_keyframe, before.scale);
            let (world_from_keyframe, scale) = (aligned.isometry, aligned.scaling());
            self.keyframes.place(ordinal, &PlacedKeyframe { world_from_keyframe, scale, ..before })?;
        }
        Ok(())
    }

    /// Expands the trajectory with the keyframes' final places and closes all files; a file that cannot be written does
    /// not keep the others from being.
    ///
    /// # Errors
    /// [`OutputError`] when the disk does not take it.
    pub fn finish(mut self) -> Result<TrajectorySummary, OutputError> {
        let closed = self.frames_csv.finish().and(self.odometry.finish());
        let logs = [self.frame_log.path().to_owned(), self.keyframes.path().to_owned()];
        let mut frames = self.frame_log.into_reader()?;
        let summary = trajectory::expand(&self.dir, &mut frames, &mut self.keyframes)?;
        for log in &logs {
            std::fs::remove_file(log).map_err(OutputError::write(log))?;
        }
        closed.map(|()| summary)
    }
}

/// Figures and pictures of an earlier run say nothing about this one, even if this one never comes to its end.
fn remove_earlier_judgements(dir: &Path) -> Result<(), OutputError> {
    let pictures = std::fs::read_dir(dir.join("renders")).into_iter().flatten().flatten().map(|entry| entry.path());
    let is_ours = |path: &PathBuf| {
        let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        name.ends_with("_camera.jpg") || name.ends_with("_render.jpg")
    };
    let reports = ["report.json", "report.html", "eval.json", "loops.csv", "views.csv"].map(|name| dir.join(name));
    for path in reports.into_iter().filter(|path| path.is_file()).chain(pictures.filter(is_ours)) {
        std::fs::remove_file(&path).map_err(OutputError::write(&path))?;
    }
    Ok(())
}

#[cfg(test)]
#[path = "folder_tests.rs"]
mod tests;
