//! Reading pages and chunks of a map that is still being written.

use super::queue::Buffer;
use super::{StoreError, layout};
use kilogs_core::store::{RecordProblem, decode_chunk, decode_page};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// A file that can be read back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StoredFile {
    /// Page with this id.
    Page(u32),
    /// Chunk with this id.
    Chunk(u32),
}

/// A file that was asked for.
#[derive(Debug)]
pub struct ReadFile {
    pub(super) file: StoredFile,
    pub(super) memory: Buffer,
    pub(super) n_bytes: usize,
}

impl ReadFile {
    /// Which file.
    pub fn file(&self) -> StoredFile {
        self.file
    }

    /// Its bytes, whole and verified; none when it is gone or damaged, which stands in the log.
    pub fn bytes(&self) -> Option<&[u8]> {
        self.memory.get(..self.n_bytes).filter(|bytes| !bytes.is_empty())
    }
}

/// Reads a file into memory of fixed size and verifies it; its length.
pub(super) fn read_verified(folder: &Path, file: StoredFile, memory: &mut [u8]) -> Result<usize, StoreError> {
    let path = match file {
        StoredFile::Page(id) => layout::page_path(folder, id),
        StoredFile::Chunk(id) => layout::chunk_path(folder, id),
    };
    let failed = |e| StoreError::read("reading back", &path, e);
    let mut source = File::open(&path).map_err(failed)?;
    let length = source.metadata().map_err(failed)?.len();
    let damaged = |problem| StoreError::Damaged { path: path.clone(), problem };
    let wrong = damaged(RecordProblem::Inconsistent { element: 0 });
    // A file that is longer than the buffers is none that was written with them.
    let Some(bytes) = usize::try_from(length).ok().and_then(|length| memory.get_mut(..length)) else {
        return Err(wrong);
    };
    source.read_exact(bytes).map_err(failed)?;
    let (verified, id) = match file {
        StoredFile::Page(id) => (decode_page(bytes).map(|(label, _)| label.page_id), id),
        StoredFile::Chunk(id) => (decode_chunk(bytes).map(|chunk| chunk.label.chunk_id), id),
    };
    match verified {
        Ok(found) if found == id => Ok(bytes.len()),
        Ok(_) => Err(wrong),
        Err(problem) => Err(damaged(problem)),
    }
}
