//! How full each row was, and how often it turned something away.

use super::Row;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Peaks and refusals of every row; shared by all threads, and free of allocation.
#[derive(Debug, Default)]
pub struct Usage {
    /// One more than the most elements seen; 0 for a row that nobody looked at.
    peak: [AtomicU64; Row::COUNT],
    refused: [AtomicU64; Row::COUNT],
}

impl Usage {
    /// Notes that `row` holds `elements` now.
    pub fn observe(&self, row: Row, elements: usize) {
        self.peak[row as usize].fetch_max((elements as u64).saturating_add(1), Relaxed);
    }

    /// Notes that `row` was full and turned `elements` away.
    pub fn refuse(&self, row: Row, elements: usize) {
        self.refused[row as usize].fetch_add(elements as u64, Relaxed);
    }

    /// The most elements that `row` ever held; `None` when nobody looked.
    pub fn peak(&self, row: Row) -> Option<u64> {
        self.peak[row as usize].load(Relaxed).checked_sub(1)
    }

    /// Elements that `row` turned away.
    pub fn refused(&self, row: Row) -> u64 {
        self.refused[row as usize].load(Relaxed)
    }

    /// Elements turned away by all rows together.
    pub fn refused_in_all(&self) -> u64 {
        self.refused.iter().map(|count| count.load(Relaxed)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_highest_level_stays_and_refusals_add_up() {
        let usage = Usage::default();
        for level in [3, 7, 5] {
            usage.observe(Row::MapAnchors, level);
        }
        usage.refuse(Row::MapAnchors, 2);
        usage.refuse(Row::SplatPairs, 5);
        assert_eq!((usage.peak(Row::MapAnchors), usage.refused(Row::MapAnchors)), (Some(7), 2));
        usage.observe(Row::MapKeyframes, 0);
        assert_eq!(
            (usage.peak(Row::MapVoxels), usage.peak(Row::MapKeyframes)),
            (None, Some(0)),
            "unknown is not empty"
        );
        assert_eq!(usage.refused_in_all(), 7);
    }
}
