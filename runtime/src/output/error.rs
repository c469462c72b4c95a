//! Why an output could not be written.

use std::io;
use std::path::{Path, PathBuf};

/// A file of the output folder could not be written or read back.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The folder could not be made; name another one.
    #[error("making the output folder {path}: {source}; name another one with --out")]
    Folder {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file could not be written; the text says what to try.
    #[error("writing {path}: {}", advice(.source))]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file that was written earlier in the run could not be read back: it was changed from outside.
    #[error("reading back {path}: {source}; did something else change the output folder during the run?")]
    ReadBack {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
}

impl OutputError {
    pub(crate) fn write(path: &Path) -> impl FnOnce(io::Error) -> Self + '_ {
        |source| Self::Write { path: path.to_owned(), source }
    }

    pub(super) fn read_back(path: &Path) -> impl FnOnce(io::Error) -> Self + '_ {
        |source| Self::ReadBack { path: path.to_owned(), source }
    }
}

fn advice(source: &io::Error) -> String {
    match source.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            format!("{source}; free space there or name a folder on another disk with --out")
        }
        io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
            format!("{source}; name a folder that may be written with --out")
        }
        _ => source.to_string(),
    }
}
