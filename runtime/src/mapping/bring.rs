//! What comes back into memory: pages that the vehicle is about to see again.
//!
//! A page is asked for at one keyframe and taken [`RETURN_AFTER_KEYFRAMES`] later in lock-step, or as soon as it was
//! read when live. A voxel has one anchor: where a returned one meets one that is there already, that of the later drive
//! ends. The chunk before the newest goes on being trained by the views that see it, but for its decoder; what is older is
//! shown and stays as it is.

use super::fingerprint::fingerprint;
use super::mapper::{KeyframePacket, Mapper};
use super::pages::{PageGroup, group_and_part, point_in_map};
use super::sink::{PageSink, PageSource};
use crate::map_store::{StoredFile, WriteRefusal};
use crate::splat::{BACKGROUND_COLUMNS, BACKGROUND_TEXELS};
use kilogs_core::map::pool::AnchorRecord;
use kilogs_core::map::voxel::VoxelKey;
use kilogs_core::store::{PageReader, StoredAnchor, decode_chunk, decode_page};
use nalgebra::Vector3;

/// In lock-step a page is in the map so many keyframes after it was asked for.
const RETURN_AFTER_KEYFRAMES: u64 = 2;
/// A page comes back when it is nearer than this share of the distance at which pages leave.
const RETURN_SHARE: f64 = 0.6;
/// How far the way is looked along for pages, as a share of that distance.
const LOOKAHEAD_SHARE: f64 = 0.3;
/// Who makes room for a page is remoter than it by this share of that distance.
const SWAP_SHARE: f64 = 0.1;
/// Share of the anchor pool that returning pages fill: the rest is for new anchors.
const RETURN_FILL: f64 = 0.75;

impl Mapper {
    /// Takes the pages that came, and asks for those that the vehicle is about to see again. Call it before
    /// [`insert_keyframe`](Self::insert_keyframe), so that nothing is inserted that was only away.
    pub fn bring_pages<S: PageSink + PageSource>(&mut self, packet: &KeyframePacket<'_>, store: &mut S) {
        self.look_from(packet);
        self.take_what_came(store);
        // A store that is busy or has stopped is asked again with the next keyframe.
        let _ = self.ask_for_near(store);
    }

    pub(super) fn look_from(&mut self, packet: &KeyframePacket<'_>) {
        // A fit never lets pages leave for their distance.
        let lookahead_m = LOOKAHEAD_SHARE * self.settings.page_distance_m;
        let lookahead_m = if lookahead_m.is_finite() { lookahead_m } else { 0.0 };
        self.paging.directory.look_from(&packet.world_from_camera, lookahead_m);
    }

    fn take_what_came(&mut self, source: &mut dyn PageSource) {
        while let Some(&(file, asked_at)) = self.paging.coming.front() {
            let is_due = self.counters.keyframes >= asked_at + RETURN_AFTER_KEYFRAMES;
            let Some(read) = source.next(is_due) else { return };
            self.paging.coming.pop_front();
            debug_assert_eq!(read.file(), file, "files come in the order of the requests");
            match file {
                StoredFile::Page(id) => self.take_page(id, read.bytes()),
                StoredFile::Chunk(id) => self.take_chunk(id, read.bytes()),
            }
            source.give_back(read);
        }
    }

    fn ask_for_near<S: PageSink + PageSource>(&mut self, store: &mut S) -> Result<(), WriteRefusal> {
        // A page may need its chunk.
        while store.n_free() >= 2 && self.paging.coming.len() + 2 <= self.paging.coming.capacity() {
            let viewpoint = &self.paging.directory.viewpoint;
            let near_m = RETURN_SHARE * self.settings.page_distance_m;
            let missing = |group: &PageGroup| group.parts.missing().is_some() && !group.is_denied;
            let nearest = self.paging.directory.best(missing, |group| group.remoteness_m(viewpoint));
            let Some((remoteness_m, group)) = nearest.filter(|(remoteness_m, _)| *remoteness_m < near_m) else {
                break;
            };
            if !self.make_resident(group, remoteness_m, store)? {
                if let Some(group) = self.paging.directory.get_mut(group) {
                    group.is_denied = true;
                    self.counters.pages_denied += u64::from(!group.is_denial_counted);
                    group.is_denial_counted = true;
                }
                continue;
            }
            self.ask_for_a_part(group, store)?;
        }
        // Whoever was denied is looked at again with the next keyframe.
        self.paging.directory.iter_mut().for_each(|group| group.is_denied = false);
        Ok(())
    }

    fn ask_for_a_part(&mut self, group: u32, source: &mut dyn PageSource) -> Result<(), WriteRefusal> {
        let Some(known) = self.paging.directory.get_mut(group) else { return Ok(()) };
        let Some(part) = known.parts.missing() else { return Ok(()) };
        let file = StoredFile::Page(known.page_id(part));
        source.request(file)?;
        known.parts.coming |= 1 << part;
        self.paging.coming.push_back((file, self.counters.keyframes));
        Ok(())
    }

    /// Gives a group its rows; false when there is no room that somebody remoter could make.
    fn make_resident<S: PageSink + PageSource>(
        &mut self,
        group: u32,
        remoteness_m: f64,
        store: &mut S,
    ) -> Result<bool, WriteRefusal> {
        let Some(known) = self.paging.directory.get(group).copied() else { return Ok(false) };
        if known.is_resident {
            return Ok(true);
        }
        let remoter_than_m = remoteness_m + SWAP_SHARE * self.settings.page_distance_m;
        while !self.has_room_for(&known) {
            let Some((_, remotest)) = self.paging.remotest().filter(|(m, _)| *m > remoter_than_m) else {
                return Ok(false);
            };
            self.leave(remotest, store)?;
        }
        let chunk = known.chunk();
        while self.paging.chunk_rows.row(chunk).is_none() && self.paging.chunk_rows.n_free() == 0 {
            if !self.evict_remotest_chunk(remoter_than_m, store)? {
                return Ok(false);
            }
        }
        if let Some((_, true)) = self.paging.chunk_rows.hold(chunk) {
            let file = StoredFile::Chunk(chunk);
            if let Err(refused) = store.request(file) {
                self.paging.chunk_rows.release(chunk);
                return Err(refused);
            }
            self.paging.coming.push_back((file, self.counters.keyframes));
        }
        for (ordinal, placement) in known.keyframes() {
            if let Some((row, _)) = self.paging.keyframe_rows.hold(ordinal) {
                self.backend.set_keyframes(row, &[*placement]);
            }
        }
        if let Some(group) = self.paging.directory.get_mut(group) {
            (group.is_resident, group.is_denial_counted) = (true, false);
        }
        Ok(true)
    }

    /// Whether keyframes and anchors of a group fit beside those that are in memory or on their way.
    fn has_room_for(&self, group: &PageGroup) -> bool {
        let is_incomplete = |group: &&PageGroup| group.parts.coming != 0 || group.parts.missing().is_some();
        let expected: u32 = self.paging.directory.resident().filter(is_incomplete).map(|group| group.n_stored).sum();
        let n_anchors = u64::from(self.pool.n_live()) + u64::from(expected) + u64::from(group.n_stored);
        n_anchors as f64 <= RETURN_FILL * self.capacity.anchors as f64
            && self.paging.keyframe_rows.n_free() > group.keyframes().count()
    }

    /// A chunk's decoder and sky, for its row. Without its decoder a chunk's pages would look wrong: they stay away.
    pub(super) fn take_chunk(&mut self, chunk: u32, bytes: Option<&[u8]>) {
        let Some(row) = self.row_of_chunk(chunk) else { return };
        let view = bytes.and_then(|bytes| decode_chunk(bytes).ok());
        let is_usable = match &view {
            Some(view) => self.decoders.take(view.decoder),
            None => !self.decoders.is_learned(),
        };
        if let Some(view) = view
            && view.background_width as usize == BACKGROUND_COLUMNS
            && view.read_background(&mut self.sky.texels) == BACKGROUND_TEXELS
        {
            self.backend.write_background(row, &self.sky.texels);
        }
        if self.decoders.is_learned() {
            self.backend.write_decoder(row, self.decoders.weights());
        }
        self.share_decoder();
        if !is_usable {
            let of_chunk = self.paging.directory.iter_mut().filter(|group| group.chunk() == chunk);
            of_chunk.for_each(|group| group.parts.lost |= group.parts.stored & !group.parts.arrived);
        }
    }

    fn take_page(&mut self, page_id: u32, bytes: Option<&[u8]>) {
        let (group, part) = group_and_part(page_id);
        let Some(known) = self.paging.directory.get_mut(group) else { return };
        known.parts.coming &= !(1 << part);
        if known.parts.lost & (1 << part) != 0 {
            self.counters.pages_lost += 1;
            return;
        }
        let page = bytes.and_then(|bytes| decode_page(bytes).ok());
        let is_possible = page.as_ref().is_some_and(|(label, _)| {
            label.page_id == page_id && label.gaussians_per_anchor as usize <= self.capacity.gaussians_per_anchor
        });
        let Some((label, anchors)) = page.filter(|_| is_possible) else {
            known.parts.lost |= 1 << part;
            self.counters.pages_lost += 1;
            return;
        };
        let n_anchors = label.n_anchors;
        if self.pool.capacity() - self.pool.n_live() < n_anchors
            || self.grid.capacity() - self.grid.len() < n_anchors as usize
        {
            // It is asked for again when there is room.
            self.counters.pages_denied += 1;
            return;
        }
        let known = *known;
        let fingerprint = self.take_anchors(&known, part, anchors);
        if let Some(known) = self.paging.directory.get_mut(group) {
            known.parts.arrived |= 1 << part;
            known.fingerprint = known.fingerprint.wrapping_add(fingerprint);
        }
        self.counters.pages_returned += 1;
        self.counters.anchors_resident_peak = self.counters.anchors_resident_peak.max(u64::from(self.pool.n_live()));
    }

    /// Puts the anchors of a page into pool, grid and backend; the sum of their fingerprints.
    fn take_anchors(&mut self, group: &PageGroup, part: u8, mut anchors: PageReader<'_>) -> u64 {
        let Some(chunk_row) = self.row_of_chunk(group.chunk()) else { return 0 };
        let mut sum = 0_u64;
        self.staging.clear();
        while let Some((anchor, feature)) = anchors.next_with_feature(&mut self.returning) {
            sum = sum.wrapping_add(fingerprint(&anchor, &feature, &self.returning));
            let Some(voxel) = voxel_of(group, &anchor) else { continue };
            let Some(row) = self.keyframe_row(anchor.keyframe_id) else { continue };
            let seen_from_m = group.placement(anchor.keyframe_id).map_or_else(Vector3::zeros, |at| at.translation_m);
            if let Some(other) = self.grid.get(voxel)
                && self.is_shown_to(other, voxel, &seen_from_m)
            {
                self.counters.anchors_merged += 1;
                if !self.is_of_later_drive(other, anchor.keyframe_id) {
                    continue;
                }
                self.end(other);
            }
            let (keyframe_ordinal, n_gaussians) = (anchor.keyframe_id, anchor.n_gaussians);
            let record = AnchorRecord { voxel, keyframe_ordinal, n_gaussians, page_part: part };
            let Ok(handle) = self.pool.insert(record) else { continue };
            if self.grid.insert(voxel, handle.slot).is_err() {
                self.pool.remove(handle);
                continue;
            }
            if self.staging.is_full() {
                self.write_staged();
            }
            self.staging.push_whole(handle.slot, anchor.to_header(row, chunk_row), &feature, &self.returning);
        }
        self.write_staged();
        sum
    }

    fn write_staged(&mut self) {
        self.backend.write_anchors(&self.staging.slots, &self.staging.headers, &self.staging.params);
        if self.decoders.is_learned() {
            self.backend.write_features(&self.staging.slots, &self.staging.features);
        }
        self.staging.clear();
    }
}

/// The voxel that a stored anchor stands for, where its keyframe is now.
fn voxel_of(group: &PageGroup, anchor: &StoredAnchor) -> Option<VoxelKey> {
    let placement = group.placement(anchor.keyframe_id)?;
    let in_keyframe_m = Vector3::from(anchor.position_in_keyframe_m.map(f64::from));
    VoxelKey::containing(anchor.level, point_in_map(placement, in_keyframe_m))
}
