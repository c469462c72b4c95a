//! Which row of one of the backend's tables belongs to which id, shared by those who need it.

use std::collections::BTreeMap;

/// Rows `0..capacity`, given to ids for as long as somebody holds them.
#[derive(Debug)]
pub(super) struct RowTable {
    rows: BTreeMap<u32, (u32, u32)>,
    free: Vec<u32>,
}

impl RowTable {
    pub(super) fn new(capacity: usize) -> Self {
        let last = u32::try_from(capacity).unwrap_or(u32::MAX);
        Self { rows: BTreeMap::new(), free: (0..last).rev().collect() }
    }

    /// Row of an id that is held.
    pub(super) fn row(&self, id: u32) -> Option<u32> {
        self.rows.get(&id).map(|(row, _)| *row)
    }

    /// Id that a row is held for.
    pub(super) fn id_in_row(&self, row: u32) -> Option<u32> {
        self.rows.iter().find(|(_, (held, _))| *held == row).map(|(id, _)| *id)
    }

    /// Holds the row of `id`; true when the row is newly given and must be filled. `None` when all are in use.
    pub(super) fn hold(&mut self, id: u32) -> Option<(u32, bool)> {
        if let Some((row, holders)) = self.rows.get_mut(&id) {
            *holders += 1;
            return Some((*row, false));
        }
        let row = self.free.pop()?;
        self.rows.insert(id, (row, 1));
        Some((row, true))
    }

    /// Lets go of `id`; its row is free when nobody else holds it.
    pub(super) fn release(&mut self, id: u32) {
        let Some((row, holders)) = self.rows.get_mut(&id) else { return };
        *holders -= 1;
        if *holders == 0 {
            let row = *row;
            self.rows.remove(&id);
            self.free.push(row);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_is_shared_until_the_last_lets_go() {
        let mut table = RowTable::new(2);
        assert_eq!(table.hold(70), Some((0, true)));
        assert_eq!(table.hold(80), Some((1, true)));
        assert_eq!(table.hold(70), Some((0, false)));
        assert_eq!(table.hold(90), None);
        table.release(70);
        assert_eq!(table.hold(90), None, "70 is still held once");
        table.release(70);
        assert_eq!((table.row(70), table.hold(90)), (None, Some((0, true))));
        assert_eq!([0, 1, 2].map(|row| table.id_in_row(row)), [Some(90), Some(80), None]);
    }
}
