//! A page: the anchors of a few consecutive keyframes with their Gaussians.

use super::feature::StoredFeature;
use super::record::{self, PREFIX_BYTES, RecordKind, RecordProblem};
use crate::map::decoder::NO_FEATURE;
use crate::map::{AnchorFeature, AnchorHeader, GaussianParams};
use core::fmt;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// What a page holds; readable without its body.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct PageLabel {
    /// Ordinal of the page in the map; names its file.
    pub page_id: u32,
    /// Chunk whose decoder and background belong to it.
    pub chunk_id: u32,
    /// First keyframe whose anchors may be here.
    pub first_keyframe_id: u32,
    /// Last keyframe whose anchors may be here.
    pub last_keyframe_id: u32,
    /// Anchors in the body; counted while encoding.
    pub n_anchors: u32,
    /// Gaussians in the body; counted while encoding.
    pub n_gaussians: u32,
    /// Most Gaussians that one anchor may have.
    pub gaussians_per_anchor: u32,
    /// How many times this page was written before (0 the first time).
    pub revision: u32,
}

/// An anchor as stored: [`AnchorHeader`] with the keyframe's id in place of its row.
#[derive(Clone, Copy, Debug, PartialEq, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
pub struct StoredAnchor {
    /// Centre of the anchor's voxel, m, in the frame of the keyframe that spawned it.
    pub position_in_keyframe_m: [f32; 3],
    /// Id of that keyframe.
    pub keyframe_id: u32,
    /// Natural logarithm of the anchor's local scale l, per axis, m.
    pub log_extent: [f32; 3],
    /// Level of detail, 0 (finest) to 4.
    pub level: u8,
    /// How many Gaussians follow.
    pub n_gaussians: u8,
    /// What follows before the Gaussians: 0 nothing, 1 a [`StoredFeature`].
    pub feature_kind: u16,
}
const _: () = assert!(size_of::<StoredAnchor>() == 32);

impl StoredAnchor {
    /// The anchor without its place in the resident tables.
    pub fn from_header(anchor: &AnchorHeader, keyframe_id: u32) -> Self {
        Self {
            position_in_keyframe_m: anchor.position_in_keyframe_m,
            keyframe_id,
            log_extent: anchor.log_extent,
            level: anchor.level,
            n_gaussians: anchor.n_gaussians,
            feature_kind: 0,
        }
    }

    /// The anchor at its place in the resident tables.
    pub fn to_header(&self, keyframe_row: u32, chunk_row: u16) -> AnchorHeader {
        AnchorHeader {
            position_in_keyframe_m: self.position_in_keyframe_m,
            keyframe_row,
            log_extent: self.log_extent,
            level: self.level,
            n_gaussians: self.n_gaussians,
            chunk_row,
        }
    }
}

const LABEL_BYTES: usize = PREFIX_BYTES + size_of::<PageLabel>();

/// Bytes of a page file before its body: all that listing pages has to read.
pub const PAGE_HEADER_BYTES: usize = BODY_START;

const BODY_START: usize = LABEL_BYTES + PREFIX_BYTES;

/// Largest size of a page file, for buffers and budgets: with a feature for every anchor, or for none.
pub const fn page_file_bytes(n_anchors: usize, n_gaussians: usize, has_features: bool) -> usize {
    let feature_bytes = if has_features { size_of::<StoredFeature>() } else { 0 };
    BODY_START + n_anchors * (size_of::<StoredAnchor>() + feature_bytes) + n_gaussians * size_of::<GaussianParams>()
}

/// Most anchors of a page in so many bytes: as many as fit when each has all its Gaussians and a feature.
pub const fn page_anchors(page_bytes: usize, gaussians_per_anchor: usize) -> usize {
    let anchor_bytes = page_file_bytes(1, gaussians_per_anchor, true) - BODY_START;
    page_bytes.saturating_sub(BODY_START) / anchor_bytes
}

/// The anchor does not fit into the page any more; the page is unchanged.
///
/// Finish this page and put the anchor into another one; several pages may cover the same keyframes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageFull {
    /// Bytes that the page's memory has.
    pub capacity_bytes: u32,
}

impl fmt::Display for PageFull {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "the page's {} bytes are in use", self.capacity_bytes)
    }
}

impl core::error::Error for PageFull {}

/// Fills a page anchor by anchor in memory of the caller, which bounds it: at [`page_anchors`], so that a page can be
/// written again in the same memory whatever its anchors were given meanwhile.
#[derive(Debug)]
pub struct PageEncoder<B> {
    memory: B,
    label: PageLabel,
    used_bytes: usize,
}

impl<B: AsMut<[u8]> + AsRef<[u8]>> PageEncoder<B> {
    /// Begins an empty page; the label's counts are set while encoding.
    ///
    /// # Errors
    /// [`PageFull`] when the memory does not even hold an empty page.
    pub fn new(memory: B, label: PageLabel) -> Result<Self, PageFull> {
        let capacity_bytes = saturate(memory.as_ref().len());
        if memory.as_ref().len() < BODY_START {
            return Err(PageFull { capacity_bytes });
        }
        Ok(Self { memory, label: PageLabel { n_anchors: 0, n_gaussians: 0, ..label }, used_bytes: BODY_START })
    }

    /// Appends an anchor without a feature and those of `gaussians` that it uses (the first `anchor.n_gaussians`).
    ///
    /// # Errors
    /// [`PageFull`] when the page has its anchors, or when this one has more Gaussians than the label or the slice allows.
    pub fn push(&mut self, anchor: &StoredAnchor, gaussians: &[GaussianParams]) -> Result<(), PageFull> {
        self.push_with_feature(anchor, &NO_FEATURE, gaussians)
    }

    /// Appends an anchor with its feature, which takes room only when it is not zero.
    ///
    /// # Errors
    /// Like [`push`](Self::push).
    pub fn push_with_feature(
        &mut self,
        anchor: &StoredAnchor,
        feature: &AnchorFeature,
        gaussians: &[GaussianParams],
    ) -> Result<(), PageFull> {
        let full = PageFull { capacity_bytes: saturate(self.memory.as_ref().len()) };
        let per_anchor = self.label.gaussians_per_anchor;
        let is_full = self.label.n_anchors as usize >= page_anchors(self.memory.as_ref().len(), per_anchor as usize);
        if is_full || u32::from(anchor.n_gaussians) > per_anchor {
            return Err(full);
        }
        let gaussians = gaussians.get(..usize::from(anchor.n_gaussians)).ok_or(full)?;
        let feature = StoredFeature::nearest(feature);
        let feature_bytes = feature.as_ref().map_or(&[][..], |feature| feature.as_bytes());
        let anchor = StoredAnchor { feature_kind: u16::from(feature.is_some()), ..*anchor };
        let feature_start = self.used_bytes + size_of::<StoredAnchor>();
        let gaussians_start = feature_start + feature_bytes.len();
        let end = gaussians_start + size_of_val(gaussians);
        let memory = self.memory.as_mut();
        memory.get_mut(gaussians_start..end).ok_or(full)?.copy_from_slice(gaussians.as_bytes());
        memory.get_mut(feature_start..gaussians_start).ok_or(full)?.copy_from_slice(feature_bytes);
        memory.get_mut(self.used_bytes..feature_start).ok_or(full)?.copy_from_slice(anchor.as_bytes());
        self.used_bytes = end;
        self.label.n_anchors += 1;
        self.label.n_gaussians += u32::from(anchor.n_gaussians);
        Ok(())
    }

    /// What the page holds so far.
    pub fn label(&self) -> PageLabel {
        self.label
    }

    /// Seals the page; the first `.1` bytes of the returned memory are the file.
    ///
    /// # Errors
    /// [`PageFull`] when the body is longer than 4 GiB.
    pub fn finish(mut self) -> Result<(B, usize), PageFull> {
        let full = PageFull { capacity_bytes: saturate(self.memory.as_ref().len()) };
        let memory = self.memory.as_mut();
        record::write(RecordKind::PageLabel, &self.label, memory).ok_or(full)?;
        let body = memory.get_mut(LABEL_BYTES..).ok_or(full)?;
        record::seal(RecordKind::PageBody, body, self.used_bytes - BODY_START).ok_or(full)?;
        Ok((self.memory, self.used_bytes))
    }

    /// Gives the memory back without a page.
    pub fn abandon(self) -> B {
        self.memory
    }
}

fn saturate(bytes: usize) -> u32 {
    u32::try_from(bytes).unwrap_or(u32::MAX)
}

/// Label of the page that begins with `bytes`; says nothing about its body.
///
/// # Errors
/// [`RecordProblem`] when the label is damaged.
pub fn decode_page_label(bytes: &[u8]) -> Result<PageLabel, RecordProblem> {
    record::open_as(RecordKind::PageLabel, bytes)
}

/// Label and length of the page file that begins with `bytes` (at least [`PAGE_HEADER_BYTES`]); its body is not looked
/// at.
///
/// # Errors
/// [`RecordProblem`] when what stands before the body is damaged.
pub fn page_length(bytes: &[u8]) -> Result<(PageLabel, usize), RecordProblem> {
    let label = decode_page_label(bytes)?;
    let body = bytes.get(LABEL_BYTES..).unwrap_or_default();
    match record::length(RecordKind::PageBody, body) {
        Ok(length) => Ok((label, LABEL_BYTES.saturating_add(length))),
        Err(RecordProblem::Truncated { .. }) => Err(record::truncated(bytes.len(), PAGE_HEADER_BYTES)),
        Err(problem) => Err(problem),
    }
}

/// Verifies a whole page file and reads it anchor by anchor.
///
/// # Errors
/// [`RecordProblem`] when label or body are damaged or contradict each other; nothing of the page may be used.
pub fn decode_page(bytes: &[u8]) -> Result<(PageLabel, PageReader<'_>), RecordProblem> {
    let label = decode_page_label(bytes)?;
    let rest = bytes.get(LABEL_BYTES..).unwrap_or_default();
    let body = record::open(RecordKind::PageBody, rest).map_err(|problem| match problem {
        RecordProblem::Truncated { needed, .. } => {
            record::truncated(bytes.len(), LABEL_BYTES.saturating_add(needed as usize))
        }
        other => other,
    })?;
    let trailing = rest.len() != PREFIX_BYTES + body.len();
    if trailing || label.first_keyframe_id > label.last_keyframe_id {
        return Err(RecordProblem::Inconsistent { element: 0 });
    }
    check_body(&label, body)?;
    Ok((label, PageReader { body }))
}

/// Every anchor lies inside the body, belongs to the page's keyframes, and the counts add up.
fn check_body(label: &PageLabel, body: &[u8]) -> Result<(), RecordProblem> {
    let (mut n_anchors, mut n_gaussians) = (0u32, 0u32);
    let mut rest = body;
    while !rest.is_empty() {
        let wrong = RecordProblem::Inconsistent { element: n_anchors };
        let (anchor, after) = StoredAnchor::read_from_prefix(rest).map_err(|_| wrong)?;
        let own = (label.first_keyframe_id..=label.last_keyframe_id).contains(&anchor.keyframe_id);
        let count = u32::from(anchor.n_gaussians);
        if !own || count > label.gaussians_per_anchor {
            return Err(wrong);
        }
        let (feature, after) = read_feature(&anchor, after).ok_or(wrong)?;
        if feature.is_some_and(|feature| !feature.is_finite()) {
            return Err(wrong);
        }
        rest = after.get(count as usize * size_of::<GaussianParams>()..).ok_or(wrong)?;
        n_anchors += 1;
        n_gaussians += count;
    }
    if (n_anchors, n_gaussians) != (label.n_anchors, label.n_gaussians) {
        return Err(RecordProblem::Inconsistent { element: n_anchors });
    }
    Ok(())
}

/// The feature of an anchor, if it has one, and the bytes behind it; `None` when there cannot be one.
fn read_feature<'a>(anchor: &StoredAnchor, bytes: &'a [u8]) -> Option<(Option<StoredFeature>, &'a [u8])> {
    match anchor.feature_kind {
        0 => Some((None, bytes)),
        1 => StoredFeature::read_from_prefix(bytes).ok().map(|(feature, rest)| (Some(feature), rest)),
        _ => None,
    }
}

/// The anchors of a verified page, in stored order.
#[derive(Clone, Copy, Debug)]
pub struct PageReader<'a> {
    body: &'a [u8],
}

impl PageReader<'_> {
    /// Next anchor; its Gaussians go to the front of `gaussians`, as many as fit. `None` after the last.
    pub fn next_anchor(&mut self, gaussians: &mut [GaussianParams]) -> Option<StoredAnchor> {
        self.next_with_feature(gaussians).map(|(anchor, _)| anchor)
    }

    /// Like [`next_anchor`](Self::next_anchor), with the anchor's feature; zero for one that has none.
    pub fn next_with_feature(&mut self, gaussians: &mut [GaussianParams]) -> Option<(StoredAnchor, AnchorFeature)> {
        let (anchor, rest) = StoredAnchor::read_from_prefix(self.body).ok()?;
        let (feature, mut rest) = read_feature(&anchor, rest)?;
        for idx in 0..usize::from(anchor.n_gaussians) {
            let (gaussian, after) = GaussianParams::read_from_prefix(rest).ok()?;
            if let Some(place) = gaussians.get_mut(idx) {
                *place = gaussian;
            }
            rest = after;
        }
        self.body = rest;
        Some((anchor, feature.map_or(NO_FEATURE, |feature| feature.feature())))
    }
}

#[cfg(test)]
mod tests;
