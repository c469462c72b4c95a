//! Who has which row of the backend's tables, and who makes room.

use super::capacity::MapperCapacity;
use super::mapper::{CHUNK_KEYFRAMES, Mapper};
use super::pages::{PAGE_KEYFRAMES, PageDirectory, PageGroup, placement_of};
use super::sink::PageSink;
use crate::map_store::{StoredFile, WriteRefusal};
use crate::splat::RowTable;
use kilogs_core::camera::Pinhole;
use kilogs_core::conventions::Rigid;
use std::collections::VecDeque;

/// The resident part of the map, and what is on its way into it.
#[derive(Debug)]
pub struct Paging {
    pub(super) directory: PageDirectory,
    pub(super) keyframe_rows: RowTable,
    pub(super) chunk_rows: RowTable,
    /// Files that were asked for, in that order, and the number of the keyframe at which they were.
    pub(super) coming: VecDeque<(StoredFile, u64)>,
    pub(super) building_chunk: Option<u32>,
    /// A chunk that is complete and waits for the sink; it keeps its row until it is taken.
    pub(super) chunk_due: Option<u32>,
    /// Groups with keyframes from here on stay: they are trained.
    newest_safe: u32,
}

impl Paging {
    /// Tables of these capacities.
    pub fn new(capacity: &MapperCapacity, camera: &Pinhole) -> Self {
        let corner = |center: f64, size: u32, focal: f64| center.max(f64::from(size) - center) / focal;
        let (x_z1, y_z1) = (corner(camera.cx, camera.width, camera.fx), corner(camera.cy, camera.height, camera.fy));
        Self {
            directory: PageDirectory::new(capacity.pages, 1.0 / (1.0 + x_z1 * x_z1 + y_z1 * y_z1).sqrt()),
            keyframe_rows: RowTable::new(capacity.keyframe_rows),
            chunk_rows: RowTable::new(capacity.chunk_rows.min(usize::from(u16::MAX))),
            coming: VecDeque::with_capacity(capacity.returning_files),
            building_chunk: None,
            chunk_due: None,
            newest_safe: 0,
        }
    }

    /// Nothing of the group is trained or on its way.
    pub(super) fn may_leave(&self, group: &PageGroup) -> bool {
        group.is_resident && group.parts.coming == 0 && group.last_ordinal() < self.newest_safe
    }

    /// The group that matters least of those that may leave, and how remote it is, m.
    pub(super) fn remotest(&self) -> Option<(f64, u32)> {
        let viewpoint = &self.directory.viewpoint;
        let remotest = self.directory.best(|group| self.may_leave(group), |group| -group.remoteness_m(viewpoint));
        remotest.map(|(negative_m, group)| (-negative_m, group))
    }

    /// The complete chunk whose pages matter least, if all of them may leave, and how remote the nearest is, m.
    fn remotest_chunk(&self) -> Option<(f64, u32)> {
        let viewpoint = &self.directory.viewpoint;
        let is_busy = |chunk: u32| [self.building_chunk, self.chunk_due].contains(&Some(chunk));
        let of_chunk = |chunk: u32| self.directory.resident().filter(move |group| group.chunk() == chunk);
        let chunks = self.chunk_rows.ids().filter(|&chunk| !is_busy(chunk));
        let evictable = chunks.filter(|&chunk| of_chunk(chunk).all(|group| self.may_leave(group)));
        let nearest_m =
            |chunk: u32| of_chunk(chunk).map(|group| group.remoteness_m(viewpoint)).fold(f64::INFINITY, f64::min);
        evictable.map(|chunk| (nearest_m(chunk), chunk)).max_by(|a, b| a.0.total_cmp(&b.0))
    }
}

/// How full the tables of the resident part of the map are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TableLoad {
    /// Keyframes with a row.
    pub keyframes: usize,
    /// Chunks with a row.
    pub chunks: usize,
    /// Pages that are in memory or can come back.
    pub pages: usize,
}

impl Mapper {
    /// How full the tables are.
    pub fn table_load(&self) -> TableLoad {
        let Paging { keyframe_rows, chunk_rows, directory, .. } = &self.paging;
        TableLoad { keyframes: keyframe_rows.n_held(), chunks: chunk_rows.n_held(), pages: directory.len() }
    }

    /// Pages that the full directory forgot: they are on disk, and do not come back in this run.
    pub fn n_forgotten_pages(&self) -> usize {
        usize::try_from(self.paging.directory.n_forgotten).unwrap_or(usize::MAX)
    }

    /// Row of a keyframe in the backend's table, while it has one.
    pub(super) fn keyframe_row(&self, ordinal: u32) -> Option<u32> {
        self.paging.keyframe_rows.row(ordinal)
    }

    /// Row of a keyframe's chunk in the backend's table, while it has one.
    pub(super) fn chunk_row(&self, ordinal: u32) -> Option<u16> {
        self.row_of_chunk(ordinal / CHUNK_KEYFRAMES)
    }

    /// Row of a chunk in the backend's table, while it has one.
    pub(super) fn row_of_chunk(&self, chunk: u32) -> Option<u16> {
        self.paging.chunk_rows.row(chunk).and_then(|row| u16::try_from(row).ok())
    }

    /// Sees to it that a keyframe finds a row, and its chunk another; what was complete is handed over for it.
    pub(super) fn make_rows(&mut self, ordinal: u32, sink: &mut dyn PageSink) -> Result<(), WriteRefusal> {
        self.paging.newest_safe = ordinal.saturating_sub(self.settings.window as u32);
        let chunk = ordinal / CHUNK_KEYFRAMES;
        if self.paging.building_chunk != Some(chunk) {
            if self.paging.building_chunk.is_some() {
                self.write_due_chunk(sink)?;
                self.paging.chunk_due = self.paging.building_chunk.take();
            }
            while self.paging.chunk_rows.hold(chunk).is_none() {
                if self.evict_remotest_chunk(f64::NEG_INFINITY, sink)? {
                    continue;
                }
                // The chunk that was complete may leave when it is written.
                self.write_due_chunk(sink)?;
                if self.paging.chunk_rows.n_free() == 0 && !self.evict_remotest_chunk(f64::NEG_INFINITY, sink)? {
                    return Err(WriteRefusal::Busy);
                }
            }
            self.paging.building_chunk = Some(chunk);
        }
        while self.paging.keyframe_rows.n_free() == 0 {
            let Some((_, remotest)) = self.paging.remotest() else { return Err(WriteRefusal::Busy) };
            self.leave(remotest, sink)?;
        }
        Ok(())
    }

    /// Gives a keyframe its row; false when there is no room for its page in the directory.
    pub(super) fn admit_keyframe(&mut self, ordinal: u32, world_from_camera: &Rigid) -> bool {
        let placement = placement_of(world_from_camera);
        if !self.paging.directory.note(ordinal, &placement) {
            return false;
        }
        let Paging { directory, keyframe_rows, chunk_rows, .. } = &mut self.paging;
        let Some(group) = directory.get_mut(ordinal / PAGE_KEYFRAMES) else { return false };
        if !group.is_resident {
            group.is_resident = true;
            chunk_rows.hold(group.chunk());
        }
        let Some((row, _)) = keyframe_rows.hold(ordinal) else { return false };
        self.backend.set_keyframes(row, &[placement]);
        true
    }

    /// Lets all pages of the complete chunk that matters least leave, if it is remoter than that, m; false when there is
    /// none.
    pub(super) fn evict_remotest_chunk(
        &mut self,
        remoter_than_m: f64,
        sink: &mut dyn PageSink,
    ) -> Result<bool, WriteRefusal> {
        let Some((_, chunk)) = self.paging.remotest_chunk().filter(|(nearest_m, _)| *nearest_m > remoter_than_m) else {
            return Ok(false);
        };
        while let Some(group) = self.paging.directory.first_resident(|group| group.chunk() == chunk) {
            self.leave(group, sink)?;
        }
        Ok(true)
    }
}
