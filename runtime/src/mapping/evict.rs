//! What leaves memory: pages when the vehicle is far away.

use super::mapper::{CHUNK_KEYFRAMES, KeyframePacket, Mapper};
use super::scratch::{NO_HEADER, Staging};
use super::sink::PageSink;
use crate::map_store::WriteRefusal;
use crate::splat::BACKGROUND_COLUMNS;
use kilogs_core::conventions::Rigid;
use kilogs_core::store::{ChunkBackground, ChunkLabel, PageLabel, StoredAnchor};
use nalgebra::Vector3;
use std::collections::VecDeque;

/// Consecutive keyframes whose anchors leave together.
pub const PAGE_KEYFRAMES: u32 = 10;
/// Share of the anchor pool above which the oldest group leaves whatever its distance.
const HIGH_WATER: f64 = 0.85;

/// Keyframes that leave together, and where they are.
#[derive(Debug, Clone, Copy)]
pub(super) struct PageGroup {
    group: u32,
    positions_m: [Vector3<f64>; PAGE_KEYFRAMES as usize],
    n_keyframes: usize,
    last_ordinal: u32,
}

/// The resident groups, oldest first.
#[derive(Debug)]
pub struct PageGroups {
    groups: VecDeque<PageGroup>,
    next_page_id: u32,
    building_chunk: Option<u32>,
    /// A chunk that is complete and waits for the sink.
    chunk_due: Option<u32>,
}

impl PageGroups {
    /// Room for the groups of the keyframes that have a row.
    pub fn new(keyframe_rows: usize) -> Self {
        let groups = VecDeque::with_capacity(keyframe_rows.div_ceil(PAGE_KEYFRAMES as usize));
        Self { groups, next_page_id: 0, building_chunk: None, chunk_due: None }
    }

    /// Notes where a keyframe is.
    pub fn note(&mut self, ordinal: u32, world_from_camera: &Rigid) {
        let group = ordinal / PAGE_KEYFRAMES;
        if self.groups.back().is_none_or(|newest| newest.group != group) {
            let fresh = PageGroup {
                group,
                positions_m: [Vector3::zeros(); PAGE_KEYFRAMES as usize],
                n_keyframes: 0,
                last_ordinal: ordinal,
            };
            debug_assert!(self.groups.len() < self.groups.capacity(), "rows were freed first");
            self.groups.push_back(fresh);
        }
        if let Some(newest) = self.groups.back_mut().filter(|newest| newest.group == group) {
            if let Some(place) = newest.positions_m.get_mut(newest.n_keyframes) {
                *place = world_from_camera.translation.vector;
                newest.n_keyframes += 1;
            }
            newest.last_ordinal = ordinal;
        }
    }

    /// Whether the anchors of a keyframe are still resident.
    pub fn holds(&self, ordinal: u32) -> bool {
        self.groups.iter().any(|group| group.group == ordinal / PAGE_KEYFRAMES)
    }
}

impl PageGroup {
    fn distance_m(&self, position_m: &Vector3<f64>) -> f64 {
        let nearest = |m: f64, p: &Vector3<f64>| m.min((p - position_m).norm());
        self.positions_m.iter().take(self.n_keyframes).fold(f64::INFINITY, nearest)
    }
}

impl Mapper {
    /// Hands over what refers to the rows that a keyframe is about to take: its own, and its chunk's.
    pub(super) fn free_rows(&mut self, ordinal: u32, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        let chunk = ordinal / CHUNK_KEYFRAMES;
        if let Some(previous) = self.groups.building_chunk.filter(|&previous| previous != chunk) {
            self.write_due_chunk(sink)?;
            self.groups.chunk_due = Some(previous);
        }
        self.groups.building_chunk = Some(chunk);
        let takes_row = |due: u32| self.chunk_row(due * CHUNK_KEYFRAMES) == self.chunk_row(ordinal);
        if self.groups.chunk_due.is_some_and(takes_row) {
            self.write_due_chunk(sink)?;
        }
        let (keyframe_rows, chunk_rows) = (self.capacity.keyframe_rows as u32, self.capacity.chunk_rows as u32);
        while let Some(oldest) = self.groups.groups.front().copied() {
            let first = oldest.group * PAGE_KEYFRAMES;
            if first + keyframe_rows > ordinal && first / CHUNK_KEYFRAMES + chunk_rows > chunk {
                break;
            }
            self.evict_group(oldest.group, sink)?;
            self.groups.groups.pop_front();
        }
        Ok(())
    }

    fn write_due_chunk(&mut self, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        if let Some(due) = self.groups.chunk_due {
            self.write_chunk(due, sink)?;
            self.groups.chunk_due = None;
        }
        Ok(())
    }

    /// Hands over the chunk that is complete, groups that are far away, and the oldest ones while memory is short.
    pub(super) fn evict_far_pages(&mut self, packet: &KeyframePacket<'_>, sink: &mut dyn PageSink) {
        // A sink that is busy now is asked again with the next keyframe.
        let _ = self.write_due_chunk(sink);
        let position_m = packet.world_from_camera.translation.vector;
        let newest_safe = packet.ordinal.saturating_sub(self.settings.window as u32);
        loop {
            let Some(oldest) = self.groups.groups.front().copied() else { return };
            let is_full = f64::from(self.pool.n_live()) > HIGH_WATER * self.capacity.anchors as f64;
            let is_far = oldest.distance_m(&position_m) > self.settings.page_distance_m;
            if !(is_far || is_full)
                || oldest.last_ordinal >= newest_safe
                || self.evict_group(oldest.group, sink).is_err()
            {
                return;
            }
            self.groups.groups.pop_front();
        }
    }

    /// Hands over the oldest group, unless it holds the newest keyframe; false when it stays.
    pub(super) fn evict_oldest_group(&mut self, sink: &mut dyn PageSink) -> bool {
        let is_last = self.groups.groups.len() < 2;
        let Some(oldest) = self.groups.groups.front().copied().filter(|_| !is_last) else { return false };
        let is_gone = self.evict_group(oldest.group, sink).is_ok();
        if is_gone {
            self.groups.groups.pop_front();
        }
        is_gone
    }

    /// Hands over every group and the chunk that is being built.
    pub(super) fn evict_everything(&mut self, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        while let Some(oldest) = self.groups.groups.front().copied() {
            self.evict_group(oldest.group, sink)?;
            self.groups.groups.pop_front();
        }
        self.write_due_chunk(sink)?;
        self.groups.chunk_due = self.groups.building_chunk.take();
        self.write_due_chunk(sink)
    }

    pub(super) fn write_chunk(&mut self, chunk: u32, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        let chunk_row = self.chunk_row(chunk * CHUNK_KEYFRAMES);
        let is_read = self.backend.read_background(chunk_row, &mut self.background);
        debug_assert!(is_read, "chunk_row is a row");
        self.read_decoder(chunk);
        let label = ChunkLabel {
            chunk_id: chunk,
            first_keyframe_id: chunk * CHUNK_KEYFRAMES,
            last_keyframe_id: chunk * CHUNK_KEYFRAMES + CHUNK_KEYFRAMES - 1,
            revision: 0,
        };
        let background = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &self.background };
        sink.write_chunk(label, self.decoders.stored(), background)
    }

    /// Hands over one group, page by page; when the sink refuses, what was handed over is gone and the rest stays.
    fn evict_group(&mut self, group: u32, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        loop {
            self.stage(0, |ordinal| ordinal / PAGE_KEYFRAMES == group);
            if self.staging.slots.is_empty() {
                return Ok(());
            }
            self.read_staged();
            let written = self.write_page(group, sink);
            if let Ok(n_stored) = written {
                self.forget(0..n_stored);
            }
            self.staging.clear();
            written?;
        }
    }

    /// Writes the staged anchors into one page, as many as fit; how many that were.
    fn write_page(&mut self, group: u32, sink: &mut dyn PageSink) -> Result<usize, WriteRefusal> {
        let label = PageLabel {
            page_id: self.groups.next_page_id,
            chunk_id: group * PAGE_KEYFRAMES / CHUNK_KEYFRAMES,
            first_keyframe_id: group * PAGE_KEYFRAMES,
            last_keyframe_id: group * PAGE_KEYFRAMES + PAGE_KEYFRAMES - 1,
            n_anchors: 0,
            n_gaussians: 0,
            gaussians_per_anchor: self.capacity.gaussians_per_anchor as u32,
            revision: 0,
        };
        let mut draft = sink.begin_page(label)?;
        let mut n_stored = 0;
        let staged = self.staging.slots.iter().zip(&self.staging.headers).zip(&self.staging.features);
        for (((&slot, header), feature), gaussians) in
            staged.zip(self.staging.params.chunks_exact(self.capacity.gaussians_per_anchor))
        {
            let record = self.pool.handle_at(slot).and_then(|handle| self.pool.get(handle).copied());
            let Some(record) = record else { continue };
            let anchor = StoredAnchor::from_header(header, record.keyframe_ordinal);
            if draft.push_with_feature(&anchor, feature, gaussians).is_err() {
                break;
            }
            n_stored += 1;
        }
        let written = draft.label();
        sink.commit_page(draft)?;
        if n_stored == 0 {
            // Not even one anchor fits a page: it never will.
            return Err(WriteRefusal::TooLarge);
        }
        self.groups.next_page_id += 1;
        self.counters.pages_written += 1;
        self.counters.anchors_stored += u64::from(written.n_anchors);
        Ok(n_stored)
    }

    /// Stages the anchors of some keyframes in slot order, as many as fit, to be read from the backend: those in slots from
    /// `first_slot` on. The slot after the last one, or `None` when all are staged.
    pub(super) fn stage(&mut self, first_slot: u32, belongs: impl Fn(u32) -> bool) -> Option<u32> {
        self.staging.clear();
        for (handle, record) in self.pool.iter().filter(|(handle, _)| handle.slot >= first_slot) {
            if self.staging.is_full() {
                return Some(handle.slot);
            }
            if belongs(record.keyframe_ordinal) {
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
