//! A text file that is written row by row through one buffer.

use super::OutputError;
use std::fmt;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::PathBuf;

/// Bytes that wait in memory before they are handed to the system.
pub(super) const BUFFER_BYTES: usize = 64 << 10;

/// An open text file whose errors name it. Writing a row takes no memory.
#[derive(Debug)]
pub(super) struct TextSink {
    path: PathBuf,
    writer: BufWriter<File>,
}

impl TextSink {
    /// Makes the file, replacing one that is there.
    pub(super) fn create(path: PathBuf) -> Result<Self, OutputError> {
        let file = File::create(&path).map_err(OutputError::write(&path))?;
        Ok(Self { writer: BufWriter::with_capacity(BUFFER_BYTES, file), path })
    }

    /// Appends text.
    pub(super) fn write(&mut self, text: fmt::Arguments<'_>) -> Result<(), OutputError> {
        self.writer.write_fmt(text).map_err(OutputError::write(&self.path))
    }

    /// Hands everything to the system; a full disk shows here at the latest.
    pub(super) fn finish(mut self) -> Result<(), OutputError> {
        self.writer.flush().map_err(OutputError::write(&self.path))
    }
}
