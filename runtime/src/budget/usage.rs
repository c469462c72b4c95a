//! How full each row was, and how often it turned something away.

use super::Row;
use crate::mapping::{ListLoad, MapRefusals};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// Peaks and refusals of every row; shared by all threads, and free of allocation.
#[derive(Debug)]
pub struct Usage {
    /// One more than the most elements seen; 0 for a row that nobody looked at.
    peak: [AtomicU64; Row::COUNT],
    refused: [AtomicU64; Row::COUNT],
}

impl Default for Usage {
    fn default() -> Self {
        let none = || std::array::from_fn(|_| AtomicU64::new(0));
        Self { peak: none(), refused: none() }
    }
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

    /// Notes how full the lists of the splat backend were.
    pub fn note_lists(&self, load: &ListLoad) {
        self.observe(Row::SplatViews, usize::from(load.n_views > 0));
        for (row, list) in [
            (Row::SplatVisibleGaussians, &load.visible),
            (Row::SplatRowEntries, &load.row_entries),
            (Row::SplatPairs, &load.pairs),
        ] {
            self.observe(row, list.peak as usize);
            self.refuse(row, usize::try_from(list.n_refused).unwrap_or(usize::MAX));
        }
    }

    /// Notes what a map that is finished had no room for.
    pub fn note_map_refusals(&self, refused: &MapRefusals<u64>) {
        for (row, n) in [
            (Row::MapNewAnchors, refused.new_anchors),
            (Row::MapAnchors, refused.anchors),
            (Row::MapVoxels, refused.voxels),
        ] {
            self.refuse(row, usize::try_from(n).unwrap_or(usize::MAX));
        }
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
    use crate::mapping::ListCount;

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

    #[test]
    fn each_full_container_is_charged_to_its_own_row() {
        let usage = Usage::default();
        usage.note_map_refusals(&MapRefusals { new_anchors: 1, anchors: 20, voxels: 300 });
        let list = |n: u32| ListCount { peak: n, n_refused: u64::from(n) * 10 };
        let load = ListLoad { n_views: 2, visible: list(4), row_entries: list(5), pairs: list(6) };
        usage.note_lists(&load);
        usage.note_lists(&load);
        for (row, peak, refused) in [
            (Row::MapNewAnchors, None, 1),
            (Row::MapAnchors, None, 20),
            (Row::MapVoxels, None, 300),
            (Row::SplatViews, Some(1), 0),
            (Row::SplatVisibleGaussians, Some(4), 80),
            (Row::SplatRowEntries, Some(5), 100),
            (Row::SplatPairs, Some(6), 120),
        ] {
            assert_eq!((usage.peak(row), usage.refused(row)), (peak, refused), "{row}");
        }
    }
}
