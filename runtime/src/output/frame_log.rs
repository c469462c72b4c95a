//! The pose of every frame relative to its keyframe: a log on disk, read once at the end.

use super::OutputError;
use super::sink::BUFFER_BYTES;
use kilogs_core::conventions::{Rigid, TimestampNs, quaternion_xyzw, rotation_from_xyzw};
use nalgebra::Translation3;
use std::fs::File;
use std::io::{BufReader, BufWriter, ErrorKind, Read, Seek, Write};
use std::path::{Path, PathBuf};
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

/// A frame that has a pose, relative to a keyframe.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct RelativePose {
    pub(super) timestamp_ns: TimestampNs,
    pub(super) keyframe_ordinal: u32,
    pub(super) keyframe_from_camera: Rigid,
}

#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Record {
    timestamp_ns: u64,
    keyframe_ordinal: u32,
    /// 0 for a frame without a pose, whose other fields mean nothing.
    has_pose: u32,
    quaternion_xyzw: [f64; 4],
    position_m: [f64; 3],
}

/// The log while it is being written.
#[derive(Debug)]
pub(super) struct FrameLog {
    path: PathBuf,
    writer: BufWriter<File>,
}

impl FrameLog {
    pub(super) fn create(path: PathBuf) -> Result<Self, OutputError> {
        let options = File::options().read(true).write(true).create(true).truncate(true).open(&path);
        let file = options.map_err(OutputError::write(&path))?;
        Ok(Self { writer: BufWriter::with_capacity(BUFFER_BYTES, file), path })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Appends a frame; `None` for one that has no pose.
    pub(super) fn push(&mut self, frame: Option<&RelativePose>) -> Result<(), OutputError> {
        let record = frame.map_or_else(Record::new_zeroed, |frame| Record {
            timestamp_ns: frame.timestamp_ns,
            keyframe_ordinal: frame.keyframe_ordinal,
            has_pose: 1,
            quaternion_xyzw: quaternion_xyzw(&frame.keyframe_from_camera.rotation),
            position_m: frame.keyframe_from_camera.translation.vector.into(),
        });
        self.writer.write_all(record.as_bytes()).map_err(OutputError::write(&self.path))
    }

    /// Ends writing and begins reading from the first frame.
    pub(super) fn into_reader(self) -> Result<FrameLogReader, OutputError> {
        let path = self.path;
        let file = self.writer.into_inner().map_err(|error| OutputError::write(&path)(error.into_error()))?;
        let mut reader = BufReader::with_capacity(BUFFER_BYTES, file);
        reader.rewind().map_err(OutputError::read_back(&path))?;
        Ok(FrameLogReader { path, reader })
    }
}

/// The log while it is being read.
#[derive(Debug)]
pub(super) struct FrameLogReader {
    path: PathBuf,
    reader: BufReader<File>,
}

impl FrameLogReader {
    /// The next frame; `Some(None)` for one without a pose, `None` at the end.
    pub(super) fn next_frame(&mut self) -> Result<Option<Option<RelativePose>>, OutputError> {
        let mut record = Record::new_zeroed();
        match self.reader.read_exact(record.as_mut_bytes()) {
            Ok(()) => {}
            Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
            Err(error) => return Err(OutputError::read_back(&self.path)(error)),
        }
        let pose = RelativePose {
            timestamp_ns: record.timestamp_ns,
            keyframe_ordinal: record.keyframe_ordinal,
            keyframe_from_camera: Rigid::from_parts(
                Translation3::from(record.position_m),
                rotation_from_xyzw(record.quaternion_xyzw),
            ),
        };
        Ok(Some((record.has_pose != 0).then_some(pose)))
    }
}
