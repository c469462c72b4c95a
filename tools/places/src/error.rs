//! What can go wrong, and what to do about it.

use kilogs_camera::source::SourceError;
use kilogs_core::frame::ImageTooShort;
use kilogs_core::frame::gray::FrameBytesMismatch;
use kilogs_core::frame::pyramid::{PyramidStorageTooSmall, WrongImageSize};
use kilogs_core::loop_closure::LoopStorageTooSmall;
use kilogs_core::places::{PlaceStorageTooSmall, VocabularyProblem};
use kilogs_core::pose_graph::PushProblem;
use kilogs_core::tracking::TrackerStorageProblem;
use kilogs_eval::EvalError;
use std::path::PathBuf;

/// Why a command ended early.
#[derive(Debug, thiserror::Error)]
pub(crate) enum PlacesError {
    /// A recording cannot be read.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// The simulated streets cannot be made.
    #[error("simulating: {0}")]
    Simulation(String),
    /// An image does not have the size that its source says.
    #[error("reading an image: {0}")]
    Bytes(#[from] FrameBytesMismatch),
    /// The same.
    #[error("reading an image: {0}")]
    Image(#[from] ImageTooShort),
    /// The same.
    #[error("reading an image: {0}")]
    Size(#[from] WrongImageSize),
    /// An image is too small or too large.
    #[error("setting up an image pyramid: {0}")]
    Pyramid(#[from] PyramidStorageTooSmall),
    /// The true poses cannot be read.
    #[error(transparent)]
    Truth(#[from] EvalError),
    /// The camera's height is not known.
    #[error("the recording does not say how the camera is mounted; put a camera.toml beside it")]
    NoMounting,
    /// The tracker refuses its memory.
    #[error(transparent)]
    Tracker(#[from] TrackerStorageProblem),
    /// The index refuses its memory.
    #[error(transparent)]
    Index(#[from] PlaceStorageTooSmall),
    /// Closing loops refuses its memory.
    #[error(transparent)]
    Loops(#[from] LoopStorageTooSmall),
    /// The graph refuses a keyframe.
    #[error("closing loops: {0}")]
    Graph(#[from] PushProblem),
    /// A file cannot be read or written.
    #[error("{what} {}: {source}", path.display())]
    File {
        /// What was being done.
        what: &'static str,
        /// To which file.
        path: PathBuf,
        /// Why not.
        source: std::io::Error,
    },
    /// The vocabulary is none.
    #[error("{} {problem}; train one: cargo run -p kilogs-places -- train --help", path.display())]
    Vocabulary {
        /// The file.
        path: PathBuf,
        /// In what it is none.
        problem: VocabularyProblem,
    },
    /// Too little to learn from.
    #[error("the recordings have {found} features; {needed} words need at least as many: name more folders")]
    TooFewFeatures {
        /// Features found.
        found: usize,
        /// Words wanted.
        needed: usize,
    },
}
