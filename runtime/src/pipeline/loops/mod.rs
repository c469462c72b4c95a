//! Loops are closed on a thread of its own, while tracking and mapping go on.
//!
//! ```text
//! tracking --image, points of a keyframe--> loops: words, recognition, verification, pose graph
//!                                             |
//!                 SharedAlignment <-----------+--> map/alignment.kgs      (both only when a loop is closed)
//! ```
//!
//! In lock-step a keyframe is through before the next one reaches the mapper. Live, one that finds no room is left out.

mod link;
mod memory;
mod places_file;
mod vocabulary;
mod work;

pub use link::LoopLink;
pub use memory::{BYTES_PER_KEYFRAME, BYTES_PER_PLACE, bytes_per_job, workspace_bytes};
pub(super) use work::{LoopSummary, alignment_before, prepare};

use crate::map_store::Alignment;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// How loops have moved the keyframes of the map, for whoever looks: ids are those of the map.
#[derive(Debug, Clone)]
pub struct SharedAlignment {
    alignment: Arc<Mutex<Alignment>>,
    is_located: Arc<AtomicBool>,
    n_found: Arc<AtomicU32>,
}

impl SharedAlignment {
    /// Shares `alignment`.
    pub fn new(alignment: Alignment) -> Self {
        Self {
            alignment: Arc::new(Mutex::new(alignment)),
            is_located: Arc::new(AtomicBool::new(true)),
            n_found: Arc::default(),
        }
    }

    /// The newest alignment; whoever changes it does so in one go.
    pub fn lock(&self) -> MutexGuard<'_, Alignment> {
        self.alignment.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether it is known where in the map the drive is. Until then nothing is mapped.
    pub fn is_located(&self) -> bool {
        self.is_located.load(Ordering::Acquire)
    }

    /// How often the drive was found in the map after it had been lost: where the odometry stood in it meant nothing before.
    pub fn n_found(&self) -> u32 {
        self.n_found.load(Ordering::Acquire)
    }

    fn set_located(&self, is_located: bool) {
        self.is_located.store(is_located, Ordering::Release);
    }

    fn note_found(&self) {
        self.n_found.fetch_add(1, Ordering::Release);
    }
}
