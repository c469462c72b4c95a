//! What leaves memory: pages when the vehicle is far away.

use super::fingerprint::fingerprint;
use super::mapper::{CHUNK_KEYFRAMES, KeyframePacket, Mapper};
use super::pages::{MAX_PARTS, PAGE_KEYFRAMES, PageGroup};
use super::scratch::{NO_HEADER, Staging};
use super::sink::PageSink;
use crate::map_store::{PageDraft, WriteRefusal};
use crate::splat::BACKGROUND_COLUMNS;
use kilogs_core::map::pool::{AnchorRecord, NOT_STORED};
use kilogs_core::store::{ChunkBackground, ChunkLabel, PageLabel, StoredAnchor};

/// Share of the anchor pool above which the remotest group leaves whatever its distance.
const HIGH_WATER: f64 = 0.85;

impl Mapper {
    pub(super) fn write_due_chunk(&mut self, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        if let Some(due) = self.paging.chunk_due {
            self.write_chunk(due, sink)?;
            self.paging.chunk_due = None;
            self.paging.chunk_rows.release(due);
        }
        Ok(())
    }

    /// Hands over the chunk that is complete, groups that are far away, and the remotest ones while memory is short.
    pub(super) fn evict_far_pages(&mut self, packet: &KeyframePacket<'_>, sink: &mut dyn PageSink) {
        // A sink that is busy now is asked again with the next keyframe.
        let _ = self.write_due_chunk(sink);
        let position_m = packet.world_from_camera.translation.vector;
        loop {
            let is_far = |group: &PageGroup| group.distance_m(&position_m) > self.settings.page_distance_m;
            let is_full = f64::from(self.pool.n_live()) > HIGH_WATER * self.capacity.anchors as f64;
            let leaving = if is_full {
                self.paging.remotest()
            } else {
                self.paging.directory.best(|group| self.paging.may_leave(group) && is_far(group), |_| 0.0)
            };
            let Some((_, group)) = leaving else { return };
            if self.leave(group, sink).is_err() {
                return;
            }
        }
    }

    /// Hands over the oldest group, unless it holds the newest keyframe; false when it stays.
    pub(super) fn evict_oldest_group(&mut self, sink: &mut dyn PageSink) -> bool {
        let is_last = self.paging.directory.resident().count() < 2;
        let oldest = self.paging.directory.first_resident(|_| !is_last);
        oldest.is_some_and(|oldest| self.leave(oldest, sink).is_ok())
    }

    /// Hands over every group and the chunk that is being built.
    pub(super) fn evict_everything(&mut self, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        while let Some(group) = self.paging.directory.first_resident(|_| true) {
            self.leave(group, sink)?;
        }
        self.write_due_chunk(sink)?;
        self.paging.chunk_due = self.paging.building_chunk.take();
        self.write_due_chunk(sink)
    }

    pub(super) fn write_chunk(&mut self, chunk: u32, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        // A chunk without a row has nothing that is not on disk.
        let Some(chunk_row) = self.row_of_chunk(chunk) else { return Ok(()) };
        let is_read = self.backend.read_background(chunk_row, &mut self.sky.texels);
        debug_assert!(is_read, "chunk_row is a row");
        self.read_decoder(chunk);
        let label = ChunkLabel {
            chunk_id: chunk,
            first_keyframe_id: chunk * CHUNK_KEYFRAMES,
            last_keyframe_id: chunk * CHUNK_KEYFRAMES + CHUNK_KEYFRAMES - 1,
            revision: 0,
        };
        let background = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &self.sky.texels };
        sink.write_chunk(label, self.decoders.stored(), background)
    }

    /// Hands over one group, page by page, and gives its rows back. Pages that are on disk as they are in memory are not
    /// written again. When the sink refuses, what was handed over is gone and the rest stays.
    pub(super) fn leave(&mut self, group: u32, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        let Some(known) = self.paging.directory.get(group).copied() else { return Ok(()) };
        let is_changed = known.parts.arrived != 0 && self.fingerprint_of(group) != known.fingerprint;
        for part in (0..MAX_PARTS).filter(|part| known.parts.arrived & (1 << part) != 0) {
            if is_changed {
                self.write_page(group, part, part, sink)?;
            }
            self.forget_part(group, part);
        }
        while self.pool.iter().any(|(_, record)| belongs(record, group, NOT_STORED)) {
            let unused = self.paging.directory.get(group).and_then(|group| group.parts.unused());
            let part = unused.ok_or(WriteRefusal::TooLarge)?;
            self.write_page(group, NOT_STORED, part, sink)?;
            self.forget_part(group, part);
        }
        for (ordinal, _) in known.keyframes() {
            self.paging.keyframe_rows.release(ordinal);
        }
        self.paging.chunk_rows.release(known.chunk());
        let Some(group) = self.paging.directory.get_mut(group) else { return Ok(()) };
        (group.is_resident, group.fingerprint) = (false, 0);
        if group.parts.stored == 0 {
            self.paging.directory.remove(known.group);
        }
        Ok(())
    }

    /// Sum over the anchors of a group that pages hold.
    fn fingerprint_of(&mut self, group: u32) -> u64 {
        let k = self.capacity.gaussians_per_anchor;
        let (mut sum, mut next_slot) = (0_u64, Some(0));
        while let Some(first_slot) = next_slot {
            next_slot = self.stage(first_slot, |record| {
                record.keyframe_ordinal / PAGE_KEYFRAMES == group && record.page_part != NOT_STORED
            });
            self.read_staged();
            let Staging { slots, headers, params, features, .. } = &self.staging;
            for (nth, &slot) in slots.iter().enumerate() {
                let Some(record) = self.pool.handle_at(slot).and_then(|handle| self.pool.get(handle)) else { continue };
                let anchor = StoredAnchor::from_header(&headers[nth], record.keyframe_ordinal);
                sum = sum.wrapping_add(fingerprint(&anchor, &features[nth], &params[nth * k..(nth + 1) * k]));
            }
        }
        self.staging.clear();
        sum
    }

    /// Writes the anchors of a group that are in page `from_part` into page `part`, as many as fit; the others are in no
    /// page then.
    fn write_page(&mut self, group: u32, from_part: u8, part: u8, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        let Some(known) = self.paging.directory.get(group).copied() else { return Ok(()) };
        let label = PageLabel {
            page_id: known.page_id(part),
            chunk_id: known.chunk(),
            first_keyframe_id: group * PAGE_KEYFRAMES,
            last_keyframe_id: group * PAGE_KEYFRAMES + PAGE_KEYFRAMES - 1,
            n_anchors: 0,
            n_gaussians: 0,
            gaussians_per_anchor: self.capacity.gaussians_per_anchor as u32,
            revision: if from_part == part { known.revision + 1 } else { 0 },
        };
        let mut draft = sink.begin_page(label)?;
        let (mut n_pushed, mut next_slot) = (0, Some(0));
        while let Some(first_slot) = next_slot {
            next_slot = self.stage(first_slot, |record| belongs(record, group, from_part));
            self.read_staged();
            let n_staged = self.staging.slots.len();
            let n_taken = self.push_staged(part, &mut draft);
            n_pushed += n_taken;
            if n_taken < n_staged {
                break;
            }
        }
        self.staging.clear();
        let written = draft.label();
        sink.commit_page(draft)?;
        if n_pushed == 0 && from_part == NOT_STORED {
            // Not even one anchor fits a page: it never will.
            return Err(WriteRefusal::TooLarge);
        }
        self.counters.pages_written += 1;
        self.counters.anchors_stored += u64::from(written.n_anchors);
        let is_new = from_part == NOT_STORED;
        if let Some(known) = self.paging.directory.get_mut(group) {
            known.parts.stored |= 1 << part;
            known.n_stored += if is_new { written.n_anchors } else { 0 };
            known.revision = known.revision.max(label.revision);
        }
        Ok(())
    }

    /// Puts the staged anchors into a page, as many as fit: they belong to it then. How many that were.
    fn push_staged(&mut self, part: u8, draft: &mut PageDraft) -> usize {
        let k = self.capacity.gaussians_per_anchor;
        let Staging { slots, headers, params, features, .. } = &self.staging;
        let mut n_pushed = 0;
        let mut is_full = false;
        for (nth, &slot) in slots.iter().enumerate() {
            let Some(record) = self.pool.handle_at(slot).and_then(|handle| self.pool.get_mut(handle)) else { continue };
            let anchor = StoredAnchor::from_header(&headers[nth], record.keyframe_ordinal);
            is_full |= draft.push_with_feature(&anchor, &features[nth], &params[nth * k..(nth + 1) * k]).is_err();
            record.page_part = if is_full { NOT_STORED } else { part };
            n_pushed += usize::from(!is_full);
        }
        n_pushed
    }

    /// Ends the anchors of a page in memory.
    fn forget_part(&mut self, group: u32, part: u8) {
        let mut next_slot = Some(0);
        while let Some(first_slot) = next_slot {
            next_slot = self.stage(first_slot, |record| belongs(record, group, part));
            self.forget(0..self.staging.slots.len());
        }
        self.staging.clear();
        if let Some(known) = self.paging.directory.get_mut(group) {
            known.parts.arrived &= !(1 << part);
        }
    }

    /// Stages the anchors that belong in slot order, as many as fit, to be read from the backend: those in slots from
    /// `first_slot` on. The slot after the last one, or `None` when all are staged.
    pub(super) fn stage(&mut self, first_slot: u32, belongs: impl Fn(&AnchorRecord) -> bool) -> Option<u32> {
        self.staging.clear();
        for (handle, record) in self.pool.iter().filter(|(handle, _)| handle.slot >= first_slot) {
            if self.staging.is_full() {
                return Some(handle.slot);
            }
            if belongs(record) {
                self.staging.push(handle.slot, NO_HEADER);
            }
        }
        None
    }

    /// Fetches what the staged slots hold; features stay 0 where the backend has none.
    pub(super) fn read_staged(&mut self) {
        let Staging { slots, headers, params, features, .. } = &mut self.staging;
        self.backend.read_anchors(slots, headers, params);
        self.backend.read_features(slots, features);
    }

    /// Ends staged anchors: they leave pool, grid and backend.
    pub(super) fn forget(&mut self, staged: std::ops::Range<usize>) {
        let slots = &self.staging.slots[staged];
        for &slot in slots {
            let Some(record) = self.pool.handle_at(slot).and_then(|handle| self.pool.remove(handle)) else { continue };
            if self.grid.get(record.voxel) == Some(slot) {
                self.grid.remove(record.voxel);
            }
        }
        self.backend.retire_anchors(slots);
    }
}

fn belongs(record: &AnchorRecord, group: u32, part: u8) -> bool {
    record.keyframe_ordinal / PAGE_KEYFRAMES == group && record.page_part == part
}
