//! Moving the map in memory to where loops have put its keyframes.
//!
//! Anchors are relative to the keyframes that spawned them, so the keyframes are all that moves: in the page directory, in
//! the backend's table, and as views to train on. Then every anchor is looked up in the voxel it is in by now. Neighbours
//! move together, so nearly every voxel still has one anchor; two of them may share one. Where a street is seen twice, the
//! anchor of the later drive ends.

use super::mapper::Mapper;
use super::pages::{PAGE_KEYFRAMES, point_in_map};
use crate::map_store::Alignment;
use crate::splat::KeyframePlacement;
use kilogs_core::conventions::{Rigid, Similarity};
use kilogs_core::map::voxel::VoxelKey;
use nalgebra::{Translation3, Vector3};

/// Keyframes so far apart are of two drives along a street.
const OTHER_DRIVE_KEYFRAMES: u32 = 50;

impl Mapper {
    /// How loops had moved keyframes when they were asked last: packets have to be where that puts them.
    pub fn alignment(&self) -> &Alignment {
        &self.alignment
    }

    /// Moves everything in memory from where the last alignment put it to where this one does. Whether what was mapped last
    /// was astray: then [`map_anew`](Self::map_anew).
    pub fn realign(&mut self, alignment: &Alignment) -> bool {
        let was_astray = self.was_astray(alignment);
        let Self { alignment: before, paging, images, .. } = self;
        let moved = |ordinal: u32| alignment.at(ordinal) * before.at(ordinal).inverse();
        paging.directory.iter_mut().for_each(|group| group.move_keyframes(moved));
        images.move_keyframes(|ordinal, world_from_camera| {
            (moved(ordinal) * Similarity::from_isometry(*world_from_camera, 1.0)).isometry
        });
        before.copy_from(alignment);
        for group in self.paging.directory.resident() {
            for (ordinal, placement) in group.keyframes() {
                if let Some(row) = self.paging.keyframe_rows.row(ordinal) {
                    self.backend.set_keyframes(row, &[*placement]);
                }
            }
        }
        self.revoxelize();
        let newest = self.images.newest(0).map_or(0, |kept| kept.keyframe.ordinal);
        self.tied_until = self.tied_until.max(newest.saturating_add(OTHER_DRIVE_KEYFRAMES));
        was_astray
    }

    /// Looks up the voxel of every anchor anew, batch by batch.
    fn revoxelize(&mut self) {
        self.grid.clear();
        let mut next_slot = Some(0);
        while let Some(first_slot) = next_slot {
            next_slot = self.stage(first_slot, |_| true);
            self.read_staged();
            // Those that end stand in front.
            let mut n_ending = 0;
            for nth in 0..self.staging.slots.len() {
                let slot = self.staging.slots[nth];
                let in_keyframe_m = Vector3::from(self.staging.headers[nth].position_in_keyframe_m).cast::<f64>();
                if self.settle(slot, in_keyframe_m) == Settled::Ends {
                    self.staging.slots.swap(n_ending, nth);
                    n_ending += 1;
                }
            }
            self.counters.anchors_merged += n_ending as u64;
            self.forget(0..n_ending);
        }
        self.staging.clear();
    }

    /// Puts an anchor into the voxel that it is in. Where that of another drive is, the later one of the two ends.
    fn settle(&mut self, slot: u32, in_keyframe_m: Vector3<f64>) -> Settled {
        let Some(record) = self.pool.handle_at(slot).and_then(|handle| self.pool.get_mut(handle)) else {
            return Settled::Stays;
        };
        let ordinal = record.keyframe_ordinal;
        let group = self.paging.directory.get(ordinal / PAGE_KEYFRAMES);
        let Some(placement) = group.and_then(|group| group.placement(ordinal)) else { return Settled::Stays };
        let in_map_m = point_in_map(placement, in_keyframe_m);
        let Some(voxel) = VoxelKey::containing(record.voxel.level(), in_map_m) else { return Settled::Stays };
        record.voxel = voxel;
        let placement_m = placement.translation_m;
        match self.grid.get(voxel) {
            Some(other) if !self.is_shown_to(other, voxel, &placement_m) => {
                // From behind, it looks otherwise.
                return Settled::Stays;
            }
            Some(other) if self.is_of_later_drive(other, ordinal) => {
                self.counters.anchors_merged += 1;
                self.end(other);
            }
            Some(other) if self.is_of_earlier_drive(other, ordinal) => return Settled::Ends,
            Some(_) => return Settled::Stays,
            None => {}
        }
        // There was room for it before.
        let _ = self.grid.insert(voxel, slot);
        Settled::Stays
    }

    /// Whether the anchor in a slot comes from a later drive along the street than this keyframe.
    pub(super) fn is_of_later_drive(&self, slot: u32, ordinal: u32) -> bool {
        self.ordinal_in(slot).is_some_and(|other| other >= ordinal.saturating_add(OTHER_DRIVE_KEYFRAMES))
    }

    fn is_of_earlier_drive(&self, slot: u32, ordinal: u32) -> bool {
        self.ordinal_in(slot).is_some_and(|other| other.saturating_add(OTHER_DRIVE_KEYFRAMES) <= ordinal)
    }

    pub(super) fn ordinal_in(&self, slot: u32) -> Option<u32> {
        let record = self.pool.handle_at(slot).and_then(|handle| self.pool.get(handle));
        record.map(|record| record.keyframe_ordinal)
    }

    /// Ends the anchor in a slot: it leaves pool, grid and backend.
    pub(super) fn end(&mut self, slot: u32) {
        let Some(record) = self.pool.handle_at(slot).and_then(|handle| self.pool.remove(handle)) else { return };
        if self.grid.get(record.voxel) == Some(slot) {
            self.grid.remove(record.voxel);
        }
        self.backend.retire_anchors(&[slot]);
    }
}

/// What becomes of an anchor whose keyframe moved.
#[derive(PartialEq)]
enum Settled {
    Stays,
    Ends,
}

/// A placement that was moved.
pub(super) fn moved_placement(moved: &Similarity, placement: &KeyframePlacement) -> KeyframePlacement {
    let isometry = Rigid::from_parts(Translation3::from(placement.translation_m), placement.rotation);
    let moved = moved * Similarity::from_isometry(isometry, placement.scale);
    KeyframePlacement {
        rotation: moved.isometry.rotation,
        translation_m: moved.isometry.translation.vector,
        scale: moved.scaling(),
    }
}
