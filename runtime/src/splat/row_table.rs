//! Which row of one of the backend's tables belongs to which id, shared by those who need it.

/// Rows `0..capacity`, given to ids for as long as somebody holds them. Takes no memory after construction.
#[derive(Debug)]
pub struct RowTable {
    /// Sorted by id.
    held: Vec<HeldRow>,
    free: Vec<u32>,
}

#[derive(Debug, Clone, Copy)]
struct HeldRow {
    id: u32,
    row: u32,
    n_holders: u32,
}

/// Bytes of one row.
pub const BYTES_PER_ROW: usize = size_of::<HeldRow>() + size_of::<u32>();

impl RowTable {
    /// All rows are free.
    pub fn new(capacity: usize) -> Self {
        let n_rows = u32::try_from(capacity).unwrap_or(u32::MAX);
        Self { held: Vec::with_capacity(capacity), free: (0..n_rows).rev().collect() }
    }

    /// Row of an id that is held.
    pub fn row(&self, id: u32) -> Option<u32> {
        self.place(id).ok().map(|place| self.held[place].row)
    }

    /// Id that a row is held for.
    pub fn id_in_row(&self, row: u32) -> Option<u32> {
        self.held.iter().find(|held| held.row == row).map(|held| held.id)
    }

    /// Ids that are held, growing.
    pub fn ids(&self) -> impl Iterator<Item = u32> {
        self.held.iter().map(|held| held.id)
    }

    /// Rows that nobody holds.
    pub fn n_free(&self) -> usize {
        self.free.len()
    }

    /// Rows that somebody holds.
    pub fn n_held(&self) -> usize {
        self.held.len()
    }

    /// Holds the row of `id`; true when the row is newly given and must be filled. `None` when all are in use.
    pub fn hold(&mut self, id: u32) -> Option<(u32, bool)> {
        match self.place(id) {
            Ok(place) => {
                let held = &mut self.held[place];
                held.n_holders += 1;
                Some((held.row, false))
            }
            Err(place) => {
                let row = self.free.pop()?;
                self.held.insert(place, HeldRow { id, row, n_holders: 1 });
                Some((row, true))
            }
        }
    }

    /// Lets go of `id`; its row is free when nobody else holds it.
    pub fn release(&mut self, id: u32) {
        let Ok(place) = self.place(id) else { return };
        self.held[place].n_holders -= 1;
        if self.held[place].n_holders == 0 {
            self.free.push(self.held.remove(place).row);
        }
    }

    fn place(&self, id: u32) -> Result<usize, usize> {
        self.held.binary_search_by_key(&id, |held| held.id)
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
