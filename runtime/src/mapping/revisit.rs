//! Streets that an earlier drive has mapped: what of them stays as it is, and what is mapped anew.
//!
//! What a finished chunk shows stays, for its own pictures are not there to be trained with: whoever comes later leaves the map
//! as it is where he sees the same, and fills in what is bare where he sees more. Before a loop is closed odometry puts the
//! street metres away from where it is in the map, and what is inserted then makes up for what stands in the wrong place. When
//! the loop puts it right, those Gaussians are wrong themselves: they end, and their keyframes are mapped anew from the pictures
//! that are still in memory.

use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use crate::map_store::Alignment;
use crate::splat::{ChunkRows, KeyframePlacement};
use kilogs_core::conventions::Rigid;
use kilogs_core::map::insertion::InsertionSettings;
use kilogs_core::map::lod::VOXEL_SIZES_M;
use nalgebra::{Point3, Vector3};

/// A loop that moves the newest keyframe less than a voxel 20 m ahead of it blurs what was inserted, and steps mend that.
const ASTRAY_M: f64 = VOXEL_SIZES_M[1] as f64;

/// From so near (m), turned by less than this (as a cosine), a view shows what a finished keyframe showed: at most a lane aside
/// or a few keyframes farther, and by a third of the angle of view of a usual camera.
const SAME_VIEW: (f64, f64) = (5.0, 0.9);

impl Mapper {
    /// Chunks before this one are finished: all but the newest one and the one before it.
    pub(super) fn first_unfinished_chunk(&self) -> u32 {
        self.images.newest(0).map_or(0, |kept| (kept.keyframe.ordinal / CHUNK_KEYFRAMES).saturating_sub(1))
    }

    /// Keyframes of finished chunks whose anchors are in memory, each with its place.
    fn finished_keyframes(&self) -> impl Iterator<Item = (u32, &KeyframePlacement)> {
        let end = self.first_unfinished_chunk() * CHUNK_KEYFRAMES;
        self.paging.directory.resident().flat_map(|group| group.keyframes()).filter(move |(ordinal, _)| *ordinal < end)
    }

    /// Rows of the chunks that are finished: what was mapped on an earlier drive is shown and not trained.
    pub(super) fn finished_chunks(&self) -> ChunkRows {
        let (unfinished, chunk_rows) = (self.first_unfinished_chunk(), &self.paging.chunk_rows);
        let finished = chunk_rows.ids().filter(|&chunk| chunk < unfinished);
        let rows = finished.filter_map(|chunk| chunk_rows.row(chunk)).filter_map(|row| u16::try_from(row).ok());
        rows.fold(ChunkRows::NONE, ChunkRows::with)
    }

    /// Whether a finished keyframe in memory is so near and looks so far the same way.
    fn is_near_finished(&self, world_from_camera: &Rigid, (most_m, least_cosine): (f64, f64)) -> bool {
        let forward = world_from_camera.rotation * Vector3::z();
        self.finished_keyframes().any(|(_, at)| {
            let distance_m = (at.translation_m - world_from_camera.translation.vector).norm();
            distance_m < most_m && (at.rotation * Vector3::z()).dot(&forward) > least_cosine
        })
    }

    /// Whether a finished keyframe in memory looks at the same: from less than a first view's worth away, and from the same
    /// side.
    fn was_seen_before(&self, world_from_camera: &Rigid) -> bool {
        self.is_near_finished(world_from_camera, (self.settings.first_view_m, 0.0))
    }

    /// Takes all poses for exact: they are given ones, which do not drift.
    pub fn trust_poses(&mut self) {
        self.tied_until = u32::MAX;
    }

    /// Whether the newest keyframes are known to be where they are in the map: given there, or put there by a loop lately.
    fn is_tied(&self) -> bool {
        self.images.newest(0).map_or(0, |kept| kept.keyframe.ordinal) < self.tied_until
    }

    /// Whether the keyframe `age` places before the newest looks at a street that an earlier drive has mapped.
    pub(super) fn is_of_known_street(&self, age: usize) -> bool {
        let kept = self.images.newest(age);
        self.is_tied() && kept.is_some_and(|kept| self.was_seen_before(&kept.keyframe.world_from_camera))
    }

    /// Whether the keyframe `age` places before the newest shows what a finished one does: the map is left as it is there.
    pub(super) fn shows_nothing_new(&self, age: usize) -> bool {
        let kept = self.images.newest(age);
        self.is_tied() && kept.is_some_and(|kept| self.is_near_finished(&kept.keyframe.world_from_camera, SAME_VIEW))
    }

    /// How the keyframe `age` places before the newest is inserted from: where an earlier drive saw the same, only what is bare
    /// is filled. While no loop says where that is, what looks wrong is inserted too.
    pub(super) fn insertion_for(&self, age: usize) -> InsertionSettings {
        InsertionSettings { only_bare: self.is_of_known_street(age), ..self.settings.insertion }
    }

    /// Whether an alignment moves the newest keyframe against the finished chunks in memory so far that what it saw of them
    /// was in the wrong place.
    pub(super) fn was_astray(&self, alignment: &Alignment) -> bool {
        let finished = self.finished_keyframes().next().map(|(ordinal, _)| ordinal);
        let newest = self.images.newest(0).map(|kept| kept.keyframe);
        let (Some(finished), Some(newest)) = (finished, newest) else { return false };
        let position = Point3::from(newest.world_from_camera.translation.vector);
        let [after, unmoved] = [newest.ordinal, finished]
            .map(|ordinal| alignment.at(ordinal) * self.alignment.at(ordinal).inverse() * position);
        (after - unmoved).norm() > ASTRAY_M
    }

    /// Ends what keyframes spawned that look at finished chunks, and inserts as much from their pictures anew.
    pub fn map_anew(&mut self) {
        let (mut n_freed, mut n_keyframes) = (0.0, 0.0);
        for age in 0..self.images.len() {
            if let Some(ordinal) = self.seen_before(age) {
                n_freed += self.end_spawned_by(ordinal);
                n_keyframes += 1.0;
            }
        }
        for age in (0..self.images.len()).rev() {
            if self.seen_before(age).is_some() {
                self.quota.give_back(n_freed / n_keyframes);
                let report = self.insert_from((age, 1), &[age + 1, age + 2, age + 3], &[], None);
                self.count_inserted(&report);
            }
        }
    }

    /// The keyframe `age` places before the newest, if it is in memory and an earlier drive saw the same.
    fn seen_before(&self, age: usize) -> Option<u32> {
        let keyframe = self.images.newest(age)?.keyframe;
        let is_unfinished = keyframe.ordinal >= self.first_unfinished_chunk() * CHUNK_KEYFRAMES;
        let is_held = self.paging.directory.holds(keyframe.ordinal);
        (is_unfinished && is_held && self.was_seen_before(&keyframe.world_from_camera)).then_some(keyframe.ordinal)
    }

    /// Ends the anchors that a keyframe spawned; how many Gaussians they had.
    fn end_spawned_by(&mut self, ordinal: u32) -> f64 {
        let (mut n_gaussians, mut next_slot) = (0.0, Some(0));
        while let Some(first_slot) = next_slot {
            next_slot = self.stage(first_slot, |record| record.keyframe_ordinal == ordinal);
            self.read_staged();
            n_gaussians += self.staging.headers.iter().map(|header| f64::from(header.n_gaussians)).sum::<f64>();
            self.counters.anchors_pruned += self.staging.slots.len() as u64;
            self.forget(0..self.staging.slots.len());
        }
        self.staging.clear();
        n_gaussians
    }
}
