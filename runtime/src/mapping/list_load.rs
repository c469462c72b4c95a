//! How full the lists of the splat backend were.

use crate::splat::RenderStats;

/// What views asked of the backend's lists since it was looked at last.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ListLoad {
    /// Views that were drawn or learned from.
    pub n_views: u32,
    /// Gaussians in view.
    pub visible: ListCount,
    /// Entries of the lists of tile rows.
    pub row_entries: ListCount,
    /// Gaussian-tile pairs.
    pub pairs: ListCount,
}

/// What one list held.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ListCount {
    /// Most of one view.
    pub peak: u32,
    /// What did not fit, of all views.
    pub n_refused: u64,
}

impl ListLoad {
    /// Adds a view; one that was refused has no lists.
    pub(super) fn add(&mut self, stats: &RenderStats) {
        if stats.refused {
            return;
        }
        self.n_views += 1;
        self.visible.add(stats.visible, stats.overflow.visible_gaussians);
        self.row_entries.add(stats.row_entries, stats.overflow.row_entries);
        self.pairs.add(stats.pairs, stats.overflow.pairs);
    }
}

impl ListCount {
    fn add(&mut self, held: u32, refused: u32) {
        self.peak = self.peak.max(held);
        self.n_refused += u64::from(refused);
    }
}
