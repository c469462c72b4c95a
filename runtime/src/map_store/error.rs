//! What can go wrong with a map on disk.

use super::WriteRefusal;
use kilogs_core::store::RecordProblem;
use std::path::{Path, PathBuf};

/// Why a map could not be written or opened. Every text names the file and says what to try.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// A file or folder of the map could not be written.
    #[error("writing the map: {action} {path}: {source}; {hint}")]
    Write {
        /// What was being done.
        action: &'static str,
        /// To which file.
        path: PathBuf,
        /// What to try.
        hint: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A file or folder of the map could not be read.
    #[error("reading the map: {action} {path}: {source}; is this the folder that holds manifest.kgs?")]
    Read {
        /// What was being done.
        action: &'static str,
        /// With which file.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A file of the map is not what was written.
    #[error("reading the map: {path}: {problem}; restore the file from a copy, or make the map again")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: RecordProblem,
    },
    /// An image of the map is not what was written.
    #[error("reading the map: image {path}: {reason}; restore the file from a copy, or leave this view out")]
    Image {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The folder holds something that is no map, and a map would be mixed with it.
    #[error("writing the map: {path} holds files that are no map; give another output folder or empty this one")]
    Occupied {
        /// The folder.
        path: PathBuf,
    },
    /// The map holds more than the budget has room for.
    #[error("a map that is too large: {path} holds {found} {what}, the budget allows {capacity}; raise {row}")]
    OverBudget {
        /// Folder of the map.
        path: PathBuf,
        /// What there is too much of.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many fit.
        capacity: usize,
        /// Row of the budget.
        row: &'static str,
    },
    /// A map that is to be gone on with was made with another camera, or in another shape.
    #[error(
        "going on with the map {path}: its {what} is not that of this run; give the camera and the budget that the map was \
         made with, or begin a new map"
    )]
    OtherMap {
        /// Folder of the map.
        path: PathBuf,
        /// What is different.
        what: &'static str,
    },
    /// The settings of the store contradict each other.
    #[error("preparing the map store: {reason}")]
    Settings {
        /// Which setting, why, and what to change.
        reason: String,
    },
    /// The end of the map could not be handed over.
    #[error(
        "writing the map: {0}; the map on disk is not complete: raise [store.page_anchors] in the budget and run again"
    )]
    Incomplete(WriteRefusal),
    /// The writing thread could not be started or ended without a result.
    #[error("writing the map: the writing thread {what}; free memory or raise the limit of threads, then run again")]
    Thread {
        /// What happened to it.
        what: &'static str,
    },
}

impl StoreError {
    /// Exit code of a program that ends because of this.
    pub const EXIT_CODE: u8 = 5;

    pub(super) fn write(action: &'static str, path: &Path, source: std::io::Error) -> Self {
        use std::io::ErrorKind;
        let hint = match source.kind() {
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded | ErrorKind::FileTooLarge => {
                "the disk is full: free space or give another output folder; what was written before stays readable"
            }
            ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => {
                "the folder cannot be written: change its permissions or give another output folder"
            }
            _ => "check the folder and the disk, then run again",
        };
        Self::Write { action, path: path.to_owned(), hint, source }
    }

    pub(super) fn read(action: &'static str, path: &Path, source: std::io::Error) -> Self {
        Self::Read { action, path: path.to_owned(), source }
    }
}

/// Something in a map that was left out because it is damaged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// File, relative to the map's folder.
    pub file: PathBuf,
    /// What is wrong.
    pub kind: DamageKind,
}

/// What is wrong with a part of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DamageKind {
    /// A record is damaged.
    Record {
        /// Byte at which the record begins.
        offset: u64,
        /// How.
        problem: RecordProblem,
    },
    /// The file's name and what it holds disagree.
    Misnamed {
        /// The id that it holds.
        id: u32,
    },
    /// The manifest counts more of these files than there are.
    FilesMissing {
        /// How many.
        n_missing: u64,
    },
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let file = self.file.display();
        match self.kind {
            DamageKind::Record { offset, problem } => write!(f, "{file} at byte {offset}: {problem}"),
            DamageKind::Misnamed { id } => write!(f, "{file} holds number {id}"),
            DamageKind::FilesMissing { n_missing } => write!(f, "{file}: {n_missing} files are lost"),
        }
    }
}
