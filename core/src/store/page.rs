//! A page: the anchors of a few consecutive keyframes with their Gaussians.

use super::record::{self, PREFIX_BYTES, RecordKind, RecordProblem};
use crate::map::{AnchorHeader, GaussianParams};
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
    /// Zero.
    pub reserved: u16,
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
            reserved: 0,
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

/// Bytes of a page file before its body: all that listing pages has to read.
pub const PAGE_HEADER_BYTES: usize = PREFIX_BYTES + size_of::<PageLabel>();

const BODY_START: usize = PAGE_HEADER_BYTES + PREFIX_BYTES;

/// Size of a page file, for buffers and budgets.
pub const fn page_file_bytes(n_anchors: usize, n_gaussians: usize) -> usize {
    BODY_START + n_anchors * size_of::<StoredAnchor>() + n_gaussians * size_of::<GaussianParams>()
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

/// Fills a page anchor by anchor in memory of the caller, which bounds it.
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

    /// Appends an anchor and those of `gaussians` that it uses (the first `anchor.n_gaussians`).
    ///
    /// # Errors
    /// [`PageFull`] when it does not fit, or when it has more Gaussians than the label or the slice allows.
    pub fn push(&mut self, anchor: &StoredAnchor, gaussians: &[GaussianParams]) -> Result<(), PageFull> {
        let full = PageFull { capacity_bytes: saturate(self.memory.as_ref().len()) };
        if u32::from(anchor.n_gaussians) > self.label.gaussians_per_anchor {
            return Err(full);
        }
        let gaussians = gaussians.get(..usize::from(anchor.n_gaussians)).ok_or(full)?;
        let middle = self.used_bytes + size_of::<StoredAnchor>();
        let end = middle + size_of_val(gaussians);
        let memory = self.memory.as_mut();
        memory.get_mut(middle..end).ok_or(full)?.copy_from_slice(gaussians.as_bytes());
        memory.get_mut(self.used_bytes..middle).ok_or(full)?.copy_from_slice(anchor.as_bytes());
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
        let body = memory.get_mut(PAGE_HEADER_BYTES..).ok_or(full)?;
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

/// Label of the page that begins with `bytes` (at least [`PAGE_HEADER_BYTES`]); says nothing about its body.
///
/// # Errors
/// [`RecordProblem`] when the label is damaged.
pub fn decode_page_label(bytes: &[u8]) -> Result<PageLabel, RecordProblem> {
    record::open_as(RecordKind::PageLabel, bytes)
}

/// Verifies a whole page file and reads it anchor by anchor.
///
/// # Errors
/// [`RecordProblem`] when label or body are damaged or contradict each other; nothing of the page may be used.
pub fn decode_page(bytes: &[u8]) -> Result<(PageLabel, PageReader<'_>), RecordProblem> {
    let label = decode_page_label(bytes)?;
    let rest = bytes.get(PAGE_HEADER_BYTES..).unwrap_or_default();
    let body = record::open(RecordKind::PageBody, rest).map_err(|problem| match problem {
        RecordProblem::Truncated { needed, .. } => {
            record::truncated(bytes.len(), PAGE_HEADER_BYTES.saturating_add(needed as usize))
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
        rest = after.get(count as usize * size_of::<GaussianParams>()..).ok_or(wrong)?;
        n_anchors += 1;
        n_gaussians += count;
    }
    if (n_anchors, n_gaussians) != (label.n_anchors, label.n_gaussians) {
        return Err(RecordProblem::Inconsistent { element: n_anchors });
    }
    Ok(())
}

/// The anchors of a verified page, in stored order.
#[derive(Clone, Copy, Debug)]
pub struct PageReader<'a> {
    body: &'a [u8],
}

impl PageReader<'_> {
    /// Next anchor; its Gaussians go to the front of `gaussians`, as many as fit. `None` after the last.
    pub fn next_anchor(&mut self, gaussians: &mut [GaussianParams]) -> Option<StoredAnchor> {
        let (anchor, mut rest) = StoredAnchor::read_from_prefix(self.body).ok()?;
        for idx in 0..usize::from(anchor.n_gaussians) {
            let (gaussian, after) = GaussianParams::read_from_prefix(rest).ok()?;
            if let Some(place) = gaussians.get_mut(idx) {
                *place = gaussian;
            }
            rest = after;
        }
        self.body = rest;
        Some(anchor)
    }
}

#[cfg(test)]
mod tests {
    use super::super::record::{as_next_version, check_every_damage_is_noticed};
    use super::*;
    use std::vec::Vec;

    fn gaussian(seed: f32) -> GaussianParams {
        GaussianParams {
            offset: [seed, seed + 0.1, seed + 0.2],
            log_scale: [-seed; 3],
            quaternion_xyzw: [0.0, 0.0, seed, 1.0],
            opacity_logit: -1.7,
            color_logit: [seed * 2.0; 3],
        }
    }

    fn anchor(keyframe_id: u32, n_gaussians: u8) -> StoredAnchor {
        StoredAnchor {
            position_in_keyframe_m: [1.0, 2.0, 3.0 + keyframe_id as f32],
            keyframe_id,
            log_extent: [-2.0, -2.1, -2.2],
            level: 3,
            n_gaussians,
            reserved: 0,
        }
    }

    const LABEL: PageLabel = PageLabel {
        page_id: 4,
        chunk_id: 1,
        first_keyframe_id: 40,
        last_keyframe_id: 49,
        n_anchors: 0,
        n_gaussians: 0,
        gaussians_per_anchor: 2,
        revision: 0,
    };

    fn page(anchors: &[StoredAnchor]) -> Vec<u8> {
        let mut memory = std::vec![0xa5; 1000];
        let mut encoder = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
        for anchor in anchors {
            encoder.push(anchor, &[gaussian(0.25), gaussian(0.5)]).expect("room for all");
        }
        let (_, length) = encoder.finish().expect("sealed");
        memory.truncate(length);
        memory
    }

    #[test]
    fn what_was_pushed_comes_back_in_order() {
        let pushed = [anchor(40, 2), anchor(49, 1), anchor(41, 0)];
        let bytes = page(&pushed);
        assert_eq!(bytes.len(), page_file_bytes(3, 3));
        let (label, mut reader) = decode_page(&bytes).expect("undamaged");
        assert_eq!(label, PageLabel { n_anchors: 3, n_gaussians: 3, ..LABEL });
        assert_eq!(decode_page_label(&bytes[..PAGE_HEADER_BYTES]), Ok(label));
        let mut scratch = [gaussian(9.0); 2];
        assert_eq!(reader.next_anchor(&mut scratch), Some(pushed[0]));
        assert_eq!(scratch, [gaussian(0.25), gaussian(0.5)]);
        scratch[1] = gaussian(9.0);
        assert_eq!(reader.next_anchor(&mut scratch), Some(pushed[1]));
        assert_eq!(scratch, [gaussian(0.25), gaussian(9.0)]);
        assert_eq!(reader.next_anchor(&mut scratch), Some(pushed[2]));
        assert_eq!(reader.next_anchor(&mut scratch), None);
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_noticed() {
        for anchors in [[].as_slice(), &[anchor(40, 2), anchor(41, 1)]] {
            check_every_damage_is_noticed(&page(anchors), |bytes| decode_page(bytes).map(|_| ()));
        }
    }

    #[test]
    fn a_page_of_the_next_version_is_refused_as_such() {
        let verdict = decode_page(&as_next_version(&page(&[anchor(40, 1)]))).map(|_| ());
        assert_eq!(verdict, Err(RecordProblem::Version { found: 2 }));
    }

    #[test]
    fn content_that_contradicts_its_label_is_refused() {
        let verdict = |bytes: &[u8]| decode_page(bytes).map(|_| ());
        let foreign_keyframe = page(&[anchor(40, 1), anchor(50, 1)]);
        assert_eq!(verdict(&foreign_keyframe), Err(RecordProblem::Inconsistent { element: 1 }));
        let mut trailing = page(&[anchor(40, 1)]);
        trailing.push(0);
        assert_eq!(verdict(&trailing), Err(RecordProblem::Inconsistent { element: 0 }));
    }

    #[test]
    fn a_full_page_refuses_and_stays_valid() {
        let mut memory = std::vec![0; page_file_bytes(1, 1) + 10];
        let mut encoder = PageEncoder::new(memory.as_mut_slice(), LABEL).expect("room for a label");
        assert_eq!(encoder.push(&anchor(40, 1), &[gaussian(1.0)]), Ok(()));
        let full = Err(PageFull { capacity_bytes: page_file_bytes(1, 1) as u32 + 10 });
        assert_eq!(encoder.push(&anchor(41, 0), &[]), full);
        assert_eq!(encoder.label().n_anchors, 1);
        let (memory, length) = encoder.finish().expect("sealed");
        assert_eq!(decode_page(&memory[..length]).map(|page| page.0.n_anchors), Ok(1));
        assert!(PageEncoder::new([0u8; BODY_START - 1], LABEL).is_err());
    }

    #[test]
    fn an_anchor_with_more_gaussians_than_allowed_is_refused() {
        let mut encoder = PageEncoder::new([0u8; 900], LABEL).expect("room for a label");
        assert!(encoder.push(&anchor(40, 3), &[gaussian(1.0); 3]).is_err(), "above the label's capacity");
        assert!(encoder.push(&anchor(40, 2), &[gaussian(1.0)]).is_err(), "above the slice");
    }
}
