//! Reading a map from its first page to its last, in the memory of one page.

use crate::map_store::{MapStoreReader, StoreError};
use kilogs_core::map::anchor::GAUSSIAN_PARAMS;
use kilogs_core::map::decoder::{residual_at_spawn, with_residual};
use kilogs_core::map::{AnchorFeature, DecoderShape, GaussianParams};
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
    decoder: ChunkDecoder,
}

/// Decoder of the chunk whose pages are being read.
struct ChunkDecoder {
    shape: DecoderShape,
    chunk_id: Option<u32>,
    /// Whether the chunk has one.
    is_learned: bool,
    file: Vec<u8>,
    weights: Vec<f32>,
    residual: Vec<f32>,
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
        let k = map.manifest().gaussians_per_anchor as usize;
        Self { map, file: Vec::new(), gaussians: vec![unused; k], decoder: ChunkDecoder::new(k) }
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
            self.decoder.open(self.map, page.chunk_id);
            let read = self.map.read_page(page.page_id, &mut self.file);
            let (_, mut anchors) = read.map_err(WalkError::Store)?;
            let mut keyframe: Option<&StoredKeyframe> = None;
            while let Some((anchor, feature)) = anchors.next_with_feature(&mut self.gaussians) {
                if keyframe.is_none_or(|known| known.keyframe_id != anchor.keyframe_id) {
                    keyframe = self.map.keyframe(anchor.keyframe_id);
                }
                let n_gaussians = usize::from(anchor.n_gaussians).min(self.gaussians.len());
                let gaussians = &mut self.gaussians[..n_gaussians];
                self.decoder.decode(&anchor, &feature, gaussians);
                visit(&WalkedAnchor { anchor_idx, keyframe, anchor: &anchor, gaussians }).map_err(WalkError::Write)?;
                anchor_idx += 1;
            }
            page_done();
        }
        Ok(())
    }
}

impl ChunkDecoder {
    fn new(gaussians_per_anchor: usize) -> Self {
        let shape = DecoderShape::new(gaussians_per_anchor);
        Self {
            shape,
            chunk_id: None,
            is_learned: false,
            file: Vec::new(),
            weights: vec![0.0; shape.len()],
            residual: vec![0.0; shape.outputs],
        }
    }

    /// Reads the decoder of a chunk; one that is lost, or that has none, adds nothing.
    fn open(&mut self, map: &MapStoreReader, chunk_id: u32) {
        if self.chunk_id.replace(chunk_id) == Some(chunk_id) {
            return;
        }
        let read = map.read_chunk(chunk_id, &mut self.file);
        self.is_learned = match read {
            Ok(chunk) => chunk.decoder.read_residual(&mut self.weights),
            Err(problem) => {
                log::warn!("anchors of chunk {chunk_id} are exported as stored: {problem}");
                false
            }
        };
    }

    /// From what an anchor stores to what its spawning keyframe sees.
    fn decode(&mut self, anchor: &StoredAnchor, feature: &AnchorFeature, gaussians: &mut [GaussianParams]) {
        if self.is_learned {
            let position_m = anchor.position_in_keyframe_m;
            residual_at_spawn(self.shape, &self.weights, feature, position_m, &mut self.residual);
            for (gaussian, residual) in gaussians.iter_mut().zip(self.residual.chunks_exact(GAUSSIAN_PARAMS)) {
                *gaussian = with_residual(gaussian, residual);
            }
        }
    }
}
