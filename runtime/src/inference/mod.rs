//! Trained networks, in a thread and a part of the memory of their own.
//!
//! [`Domain::open`] loads what the settings ask for, runs it once, and compares what that took with `[inference.arena]` of
//! the budget: what takes more is switched off. What is handed out runs on the inference thread: the calling thread, which
//! may be sealed, copies the images, waits, and copies the answer. A network that is missing, wrong or too large is a
//! warning, and the classical path goes on.

#[cfg(feature = "inference")]
mod client;
#[cfg(feature = "inference")]
mod dense;
#[cfg(feature = "inference")]
mod depth;
#[cfg(feature = "inference")]
mod domain;
mod error;
#[cfg(feature = "inference")]
mod features;
#[cfg(feature = "inference")]
mod glue;
#[cfg(feature = "inference")]
mod lpips;
#[cfg(feature = "inference")]
mod mailbox;
mod manifest;
#[cfg(feature = "inference")]
mod nearest;
#[cfg(feature = "inference")]
mod network;
#[cfg(feature = "inference")]
mod pair;
#[cfg(feature = "inference")]
mod picture;
#[cfg(feature = "inference")]
mod sparse;
#[cfg(feature = "inference")]
mod two_views;

pub use error::ModelError;
pub(crate) use manifest::usual_places;
pub use manifest::{DepthRow, DepthUnit, Manifest, ModelRow, Port, Role};

use crate::settings::{InferenceSettings, Matcher};
use kilogs_core::correspondence::{DepthPrior, PairMatcher};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

/// What a run wants of trained networks.
#[derive(Debug, Clone, Copy)]
pub struct Wanted<'a> {
    /// Where matches come from; the classical ones need no network.
    pub matcher: Matcher,
    /// Dense matching by a network, for frames where the matches have failed.
    pub dense: bool,
    /// Metric depth by a network.
    pub depth: bool,
    /// Where the networks are, and how long they may take.
    pub settings: &'a InferenceSettings,
    /// Width and height of the camera's images, px.
    pub image: (usize, usize),
    /// Focal length of the camera, px.
    pub focal_px: f32,
    /// Matches, or pixels with a depth, of one call at most.
    pub capacity: usize,
    /// `[inference.arena]` of the budget.
    pub cap_bytes: u64,
    /// An answer that comes after the deadline is no answer.
    pub is_live: bool,
}

impl Wanted<'_> {
    /// Any network at all.
    pub fn is_any(&self) -> bool {
        self.matcher != Matcher::Classical || self.dense || self.depth
    }
}

/// What the inference thread did; shared with it.
#[derive(Debug, Default)]
pub struct Counts {
    /// Questions that were answered.
    pub answered: AtomicU64,
    /// Questions whose answer came too late.
    pub late: AtomicU64,
    /// Questions that the networks could not answer.
    pub failed: AtomicU64,
    /// Parts that were wanted and are off: missing, wrong, or above the cap.
    pub switched_off: AtomicU64,
    /// The most of the heap that the inference thread had in use, bytes.
    pub peak_bytes: AtomicU64,
}

/// The trained networks of a run. What is wanted and is not there is off, and the reason was logged.
#[derive(Default)]
pub struct Domain {
    /// Matches of keypoints.
    pub sparse: Option<Box<dyn PairMatcher + Send>>,
    /// Matches of whole images.
    pub dense: Option<Box<dyn PairMatcher + Send>>,
    /// Metric depth.
    pub depth: Option<Box<dyn DepthPrior + Send>>,
    /// What the inference thread did.
    pub counts: Arc<Counts>,
}

impl Domain {
    /// Loads and tries what is wanted, on a thread that ends with the last of what is handed out. Call it before the
    /// calling thread is sealed; it takes some seconds.
    pub fn open(wanted: &Wanted<'_>) -> Self {
        if !wanted.is_any() {
            return Self::default();
        }
        open(wanted).unwrap_or_else(|error| {
            log::warn!("trained networks are off: {error}");
            let domain = Self::default();
            let n_parts = [wanted.matcher != Matcher::Classical, wanted.dense, wanted.depth].map(u64::from);
            domain.counts.switched_off.store(n_parts.iter().sum(), std::sync::atomic::Ordering::Relaxed);
            domain
        })
    }
}

/// Distance between two pictures, RGB row by row with white at 1: 0 where they look the same.
pub type Lpips = Box<dyn FnMut(&[[f32; 3]], &[[f32; 3]]) -> Result<f32, ModelError>>;

/// What measures LPIPS of pictures of a width and a height, px. It takes memory of its own, so it is for judging and not for
/// driving.
///
/// # Errors
/// [`ModelError`] when the manifest has no such network, or one that cannot be used.
#[cfg(feature = "inference")]
pub fn open_lpips(manifest: &Manifest, size: (usize, usize)) -> Result<Lpips, ModelError> {
    let mut network = lpips::LpipsNetwork::load(manifest, size)?;
    Ok(Box::new(move |first, second| network.between(first, second)))
}

/// Without the feature `inference`: nothing.
///
/// # Errors
/// [`ModelError::NotBuilt`].
#[cfg(not(feature = "inference"))]
pub fn open_lpips(_: &Manifest, _: (usize, usize)) -> Result<Lpips, ModelError> {
    Err(ModelError::NotBuilt)
}

#[cfg(feature = "inference")]
use domain::open;

#[cfg(not(feature = "inference"))]
fn open(_: &Wanted<'_>) -> Result<Domain, ModelError> {
    Err(ModelError::NotBuilt)
}

#[cfg(all(test, feature = "inference"))]
mod domain_tests;
#[cfg(all(test, feature = "inference"))]
mod tests;
