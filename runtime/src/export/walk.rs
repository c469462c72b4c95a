//! Reading a map from its first page to its last, in the memory of one page.

use crate::map_store::{MapStoreReader, StoreError};
use kilogs_core::map::GaussianParams;
use kilogs_core::store::{PageLabel, StoredAnchor, StoredKeyframe};

/// An anchor with what it needs to be placed in the map.
pub(super) struct WalkedAnchor<'a> {
    /// Ordinal among all anchors of the pages walked.
    pub(super) anchor_idx: usize,
    /// Its keyframe, `None` when the log lost it.
    pub(super) keyframe: Option<&'a StoredKeyframe>,
    pub(super) anchor: &'a StoredAnchor,
    pub(super) gaussians: &'a [GaussianParams],
}

/// Why a walk ended early.
pub(super) enum WalkError {
    Store(StoreError),
    Write(std::io::Error),
}

/// Reads pages one after the other in the same memory.
pub(super) struct PageWalk<'m> {
    map: &'m MapStoreReader,
    file: Vec<u8>,
    gaussians: Vec<GaussianParams>,
}

impl<'m> PageWalk<'m> {
    pub(super) fn new(map: &'m MapStoreReader) -> Self {
        let unused = GaussianParams {
            offset: [0.0; 3],
            log_scale: [0.0; 3],
            quaternion_xyzw: [0.0, 0.0, 0.0, 1.0],
            opacity_logit: 0.0,
            color_logit: [0.0; 3],
        };
        let gaussians = vec![unused; map.manifest().gaussians_per_anchor as usize];
        Self { map, file: Vec::new(), gaussians }
    }

    /// Whether a page can be read.
    pub(super) fn verify(&mut self, page: &PageLabel) -> Result<(), StoreError> {
        self.map.read_page(page.page_id, &mut self.file).map(|_| ())
    }

    /// Hands every anchor of `pages` over, in stored order.
    pub(super) fn walk(
        &mut self,
        pages: &[PageLabel],
        mut page_done: impl FnMut(),
        visit: &mut dyn FnMut(&WalkedAnchor<'_>) -> std::io::Result<()>,
    ) -> Result<(), WalkError> {
        let mut anchor_idx = 0;
        for page in pages {
            let read = self.map.read_page(page.page_id, &mut self.file);
            let (_, mut anchors) = read.map_err(WalkError::Store)?;
            let mut keyframe: Option<&StoredKeyframe> = None;
            while let Some(anchor) = anchors.next_anchor(&mut self.gaussians) {
                if keyframe.is_none_or(|known| known.keyframe_id != anchor.keyframe_id) {
                    keyframe = self.map.keyframe(anchor.keyframe_id);
                }
                let n_gaussians = usize::from(anchor.n_gaussians).min(self.gaussians.len());
                let gaussians = &self.gaussians[..n_gaussians];
                visit(&WalkedAnchor { anchor_idx, keyframe, anchor: &anchor, gaussians }).map_err(WalkError::Write)?;
                anchor_idx += 1;
            }
            page_done();
        }
        Ok(())
    }
}
