//! What leaves memory: pages when the vehicle is far away.

use super::mapper::{CHUNK_KEYFRAMES, KeyframePacket, Mapper};
use super::scratch::{NO_HEADER, Staging};
use super::sink::PageSink;
use crate::splat::BACKGROUND_COLUMNS;
use kilogs_core::conventions::Rigid;
use kilogs_core::store::{ChunkBackground, ChunkLabel, PageLabel, StoredAnchor};
use nalgebra::Vector3;

/// Consecutive keyframes whose anchors leave together.
pub const PAGE_KEYFRAMES: u32 = 10;
/// Groups of keyframes that can be resident; beyond, the oldest leaves whatever its distance.
const MAX_GROUPS: usize = 128;
/// Share of the anchor pool above which the oldest group leaves whatever its distance.
const HIGH_WATER: f64 = 0.85;

/// Keyframes that leave together, and where they are.
#[derive(Debug, Clone, Copy)]
struct PageGroup {
    group: u32,
    positions_m: [Vector3<f64>; PAGE_KEYFRAMES as usize],
    n_keyframes: usize,
    last_ordinal: u32,
}

/// The resident groups, oldest first.
#[derive(Debug, Default)]
pub struct PageGroups {
    groups: heapless::Deque<PageGroup, MAX_GROUPS>,
    next_page_id: u32,
    building_chunk: Option<u32>,
    /// A chunk that is complete and waits for the sink.
    chunk_due: Option<u32>,
}

impl PageGroups {
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
            // Eviction keeps at least one place free.
            let _ = self.groups.push_back(fresh);
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
    /// Hands over groups that are far away, and the oldest ones while memory is short.
    pub(super) fn evict_far_pages(&mut self, packet: &KeyframePacket<'_>, sink: &mut dyn PageSink) {
        let position_m = packet.world_from_camera.translation.vector;
        let chunk = packet.ordinal / CHUNK_KEYFRAMES;
        let previous = self.groups.building_chunk.replace(chunk);
        if let Some(previous) = previous.filter(|&previous| previous != chunk) {
            self.groups.chunk_due = Some(previous);
        }
        if let Some(due) = self.groups.chunk_due
            && self.write_chunk(due, sink)
        {
            self.groups.chunk_due = None;
        }
        let newest_safe = packet.ordinal.saturating_sub(self.settings.window as u32);
        loop {
            let Some(oldest) = self.groups.groups.front().copied() else { return };
            let is_full = f64::from(self.pool.n_live()) > HIGH_WATER * self.capacity.anchors as f64
                || self.groups.groups.len() + 1 >= MAX_GROUPS;
            let is_far = oldest.distance_m(&position_m) > self.settings.page_distance_m;
            // The row of its chunk is about to be used again.
            let loses_row = oldest.group * PAGE_KEYFRAMES / CHUNK_KEYFRAMES + self.capacity.chunk_rows as u32 <= chunk;
            if !(is_far || is_full || loses_row)
                || oldest.last_ordinal >= newest_safe
                || !self.evict_group(oldest.group, sink)
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
        let is_gone = self.evict_group(oldest.group, sink);
        if is_gone {
            self.groups.groups.pop_front();
        }
        is_gone
    }

    /// Hands over every group and the chunk that is being built; false when the sink did not take everything.
    pub(super) fn evict_everything(&mut self, sink: &mut dyn PageSink) -> bool {
        while let Some(oldest) = self.groups.groups.front().copied() {
            if !self.evict_group(oldest.group, sink) {
                return false;
            }
            self.groups.groups.pop_front();
        }
        let due = [self.groups.chunk_due, self.groups.building_chunk];
        let written = due.into_iter().flatten().all(|chunk| self.write_chunk(chunk, sink));
        if written {
            (self.groups.chunk_due, self.groups.building_chunk) = (None, None);
        }
        written
    }

    pub(super) fn write_chunk(&mut self, chunk: u32, sink: &mut dyn PageSink) -> bool {
        let chunk_row = self.chunk_row(chunk * CHUNK_KEYFRAMES);
        if !self.backend.read_background(chunk_row, &mut self.background) {
            return false;
        }
        self.read_decoder(chunk);
        let label = ChunkLabel {
            chunk_id: chunk,
            first_keyframe_id: chunk * CHUNK_KEYFRAMES,
            last_keyframe_id: chunk * CHUNK_KEYFRAMES + CHUNK_KEYFRAMES - 1,
            revision: 0,
        };
        let background = ChunkBackground { width: BACKGROUND_COLUMNS as u32, texels: &self.background };
        sink.write_chunk(label, self.decoders.stored(), background).is_ok()
    }

    /// Hands over one group, page by page; false when the sink is busy: what was handed over is gone, the rest stays.
    fn evict_group(&mut self, group: u32, sink: &mut dyn PageSink) -> bool {
        loop {
            self.stage(|ordinal| ordinal / PAGE_KEYFRAMES == group);
            if self.staging.slots.is_empty() {
                return true;
            }
            self.read_staged();
            let n_stored = self.write_page(group, sink);
            if n_stored == 0 {
                self.staging.clear();
                return false;
            }
            self.forget(0..n_stored);
            self.staging.clear();
        }
    }

    /// Writes the staged anchors into one page, as many as fit; how many that were.
    fn write_page(&mut self, group: u32, sink: &mut dyn PageSink) -> usize {
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
        let Ok(mut draft) = sink.begin_page(label) else { return 0 };
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
        if sink.commit_page(draft).is_err() {
            return 0;
        }
        self.groups.next_page_id += 1;
        self.counters.pages_written += 1;
        self.counters.anchors_stored += u64::from(written.n_anchors);
        self.counters.gaussians_stored += u64::from(written.n_gaussians);
        n_stored
    }

    /// Stages the anchors of some keyframes in slot order, as many as fit, to be read from the backend.
    pub(super) fn stage(&mut self, belongs: impl Fn(u32) -> bool) {
        self.staging.clear();
        for (handle, record) in self.pool.iter() {
            if self.staging.is_full() {
                break;
            }
            if belongs(record.keyframe_ordinal) {
                self.staging.push(handle.slot, NO_HEADER);
            }
        }
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
