//! The one block of device memory, cut into named ranges.
//!
//! Software devices enforce no limit and have no `VK_EXT_memory_budget`, so this accounting *is* the cap.

use crate::splat::Capacities;
use crate::splat::program::buffer_plan;

/// Bytes through which host and device exchange everything; larger copies go in pieces.
pub const EXCHANGE_BYTES: usize = 4 << 20;

/// No device aligns a storage buffer more coarsely.
const WIDEST_ALIGNMENT: u64 = 256;

/// Bytes of the arena of a backend with these capacities, on any device: buffers, exchange and alignment.
pub fn arena_bytes(capacities: &Capacities) -> u64 {
    let buffers = buffer_plan(capacities);
    let aligned = |bytes: usize| (bytes as u64).next_multiple_of(WIDEST_ALIGNMENT);
    buffers.iter().map(|row| aligned(row.bytes())).sum::<u64>() + EXCHANGE_BYTES as u64
}

/// A named range of the arena.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ArenaRange {
    /// Row of the budget that pays for it.
    pub row: &'static str,
    /// First byte.
    pub offset: u64,
    /// Bytes that were asked for.
    pub bytes: u64,
}

/// Hands out ranges from the front and never takes one back: everything is planned before the device is opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Arena {
    cap_bytes: u64,
    used_bytes: u64,
    ranges: Vec<ArenaRange>,
}

/// A row does not fit into the arena.
///
/// Happens when a budget plans more for the backend than its cap leaves. Lower the row, or raise the cap.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error(
    "planning the device arena: [{row}] needs {needed_bytes} B and {free_bytes} B of {cap_bytes} B are left; lower its \
     capacity in memory_budget.toml or raise the cap in [total]"
)]
pub struct ArenaFull {
    /// Row that did not fit.
    pub row: &'static str,
    /// Bytes that it needs, alignment included.
    pub needed_bytes: u64,
    /// Bytes that were left.
    pub free_bytes: u64,
    /// Bytes of the whole arena.
    pub cap_bytes: u64,
}

impl Arena {
    /// An arena that never holds more than `cap_bytes`.
    pub fn new(cap_bytes: u64) -> Self {
        Self { cap_bytes, used_bytes: 0, ranges: Vec::new() }
    }

    /// Cuts the next range, aligned to `alignment` (a power of two).
    ///
    /// # Errors
    /// [`ArenaFull`] names the row; the arena is unchanged.
    pub fn reserve(&mut self, row: &'static str, bytes: u64, alignment: u64) -> Result<ArenaRange, ArenaFull> {
        debug_assert!(alignment.is_power_of_two(), "Vulkan's alignments are powers of two");
        let padding = self.used_bytes.wrapping_neg() & (alignment - 1);
        let needed_bytes = bytes.saturating_add(padding);
        let free_bytes = self.cap_bytes - self.used_bytes;
        if needed_bytes > free_bytes {
            return Err(ArenaFull { row, needed_bytes, free_bytes, cap_bytes: self.cap_bytes });
        }
        let range = ArenaRange { row, offset: self.used_bytes + padding, bytes };
        self.used_bytes += needed_bytes;
        self.ranges.push(range);
        Ok(range)
    }

    /// Bytes handed out, padding included: what the device is asked for.
    pub fn used_bytes(&self) -> u64 {
        self.used_bytes
    }

    /// Most bytes that may be handed out.
    pub fn cap_bytes(&self) -> u64 {
        self.cap_bytes
    }

    /// Every range, from the front.
    pub fn ranges(&self) -> &[ArenaRange] {
        &self.ranges
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Offsets of the ranges that fit, and the row that did not.
    fn cut(cap: u64, rows: &[(&'static str, u64, u64)]) -> (Vec<u64>, Option<&'static str>) {
        let mut arena = Arena::new(cap);
        let refused = rows.iter().find_map(|&(row, bytes, alignment)| arena.reserve(row, bytes, alignment).err());
        assert!(arena.used_bytes() <= cap);
        (arena.ranges().iter().map(|range| range.offset).collect(), refused.map(|full| full.row))
    }

    #[test]
    fn one_byte_over_the_cap_is_refused_by_name() {
        let rows = |last| [("splat.anchors", 100, 16), ("splat.pairs", last, 16)];
        assert_eq!(cut(144, &rows(32)), (vec![0, 112], None), "to the last byte");
        assert_eq!(cut(144, &rows(33)), (vec![0], Some("splat.pairs")));
        assert_eq!(cut(143, &rows(32)), (vec![0], Some("splat.pairs")));
        assert_eq!(cut(0, &[("splat.anchors", 1, 1)]), (vec![], Some("splat.anchors")));
        assert_eq!(cut(u64::MAX, &[("a", 16, 16), ("b", u64::MAX, 16)]), (vec![0], Some("b")), "no wrapping round");
    }

    #[test]
    fn what_was_refused_leaves_room_for_what_fits() {
        let mut arena = Arena::new(64);
        assert!(arena.reserve("large", 65, 4).is_err());
        assert_eq!(arena.reserve("small", 64, 4).map(|range| range.bytes), Ok(64));
    }

    #[test]
    fn ranges_are_aligned_and_do_not_meet() {
        let (offsets, refused) = cut(4096, &[("a", 1, 1), ("b", 3, 256), ("c", 4, 64), ("d", 1, 4)]);
        assert_eq!((offsets, refused), (vec![0, 256, 320, 324], None));
    }

    #[test]
    fn the_message_says_what_to_change() {
        let full = Arena::new(10).reserve("splat.pairs", 11, 1).map_err(|e| e.to_string());
        let expected = "planning the device arena: [splat.pairs] needs 11 B and 10 B of 10 B are left; lower its capacity in memory_budget.toml or raise the cap in [total]";
        assert_eq!(full, Err(expected.to_owned()));
    }
}
