//! Which anchors live in which slot: fixed capacity, stale handles detectable.

use super::voxel::VoxelKey;
use core::fmt;
use core::ops::DerefMut;

/// Names an anchor for as long as it lives; a handle to a removed anchor finds nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AnchorHandle {
    /// Slot in the pool and in the splat backend.
    pub slot: u32,
    /// Life of that slot.
    pub generation: u32,
}

/// What the host remembers of an anchor; its trainable numbers are in the splat backend's slot.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AnchorRecord {
    /// Voxel that the anchor stands for.
    pub voxel: VoxelKey,
    /// Ordinal of the keyframe that spawned it.
    pub keyframe_ordinal: u32,
    /// How many of the slot's Gaussians are in use.
    pub n_gaussians: u8,
    /// Which page of its keyframes holds it on disk; [`NOT_STORED`] until it leaves for the first time.
    pub page_part: u8,
}

/// [`AnchorRecord::page_part`] of an anchor that no page holds.
pub const NOT_STORED: u8 = u8::MAX;

/// One slot of the pool's memory.
#[derive(Debug, Clone, Copy)]
pub struct AnchorSlot {
    generation: u32,
    state: SlotState,
}

#[derive(Debug, Clone, Copy)]
enum SlotState {
    Free { next: u32 },
    Live(AnchorRecord),
}

impl AnchorSlot {
    /// A slot that has never been used; fill the pool's memory with it.
    pub const EMPTY: Self = Self { generation: 0, state: SlotState::Free { next: END } };
}

/// End of the list of free slots.
const END: u32 = u32::MAX;

/// The anchor pool has no free slot.
///
/// Happens when pages leave more slowly than keyframes arrive. The caller should skip the insertion and
/// count it; the map stays valid.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PoolFull {
    /// Slots of the pool.
    pub capacity: u32,
}

impl fmt::Display for PoolFull {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "all {} anchor slots are in use", self.capacity)
    }
}

impl core::error::Error for PoolFull {}

/// The resident anchors; when full it refuses.
#[derive(Debug)]
pub struct AnchorPool<S> {
    slots: S,
    first_free: u32,
    n_live: u32,
}

impl<S: DerefMut<Target = [AnchorSlot]>> AnchorPool<S> {
    /// Builds an empty pool; `slots` bounds how many anchors can live at once.
    pub fn new(mut slots: S) -> Self {
        // `END` itself can never be a slot.
        let n = slots.len().min(END as usize) as u32;
        for (slot, next) in slots.iter_mut().zip(1..) {
            let next = if next < n { next } else { END };
            *slot = AnchorSlot { generation: 0, state: SlotState::Free { next } };
        }
        Self { slots, first_free: if n == 0 { END } else { 0 }, n_live: 0 }
    }

    /// Slots of the pool.
    pub fn capacity(&self) -> u32 {
        self.slots.len() as u32
    }

    /// Anchors that live.
    pub fn n_live(&self) -> u32 {
        self.n_live
    }

    /// Gives the anchor a slot; the most recently freed one first.
    ///
    /// # Errors
    /// [`PoolFull`] when every slot is in use.
    pub fn insert(&mut self, record: AnchorRecord) -> Result<AnchorHandle, PoolFull> {
        let capacity = self.capacity();
        let index = self.first_free;
        let Some(slot) = self.slots.get_mut(index as usize) else { return Err(PoolFull { capacity }) };
        let SlotState::Free { next } = slot.state else { return Err(PoolFull { capacity }) };
        slot.state = SlotState::Live(record);
        self.first_free = next;
        self.n_live += 1;
        Ok(AnchorHandle { slot: index, generation: slot.generation })
    }

    /// Frees the slot; gives back what was in it, or `None` when the handle was stale.
    pub fn remove(&mut self, handle: AnchorHandle) -> Option<AnchorRecord> {
        let first_free = self.first_free;
        let slot = self.slots.get_mut(handle.slot as usize).filter(|slot| slot.generation == handle.generation)?;
        let SlotState::Live(record) = slot.state else { return None };
        *slot = AnchorSlot { generation: slot.generation.wrapping_add(1), state: SlotState::Free { next: first_free } };
        self.first_free = handle.slot;
        self.n_live -= 1;
        Some(record)
    }

    /// The anchor, unless it was removed since the handle was made.
    pub fn get(&self, handle: AnchorHandle) -> Option<&AnchorRecord> {
        match self.slots.get(handle.slot as usize)? {
            AnchorSlot { generation, state: SlotState::Live(record) } if *generation == handle.generation => {
                Some(record)
            }
            _ => None,
        }
    }

    /// The anchor for changing, unless it was removed since the handle was made.
    pub fn get_mut(&mut self, handle: AnchorHandle) -> Option<&mut AnchorRecord> {
        match self.slots.get_mut(handle.slot as usize)? {
            AnchorSlot { generation, state: SlotState::Live(record) } if *generation == handle.generation => {
                Some(record)
            }
            _ => None,
        }
    }

    /// Handle of whatever lives in a slot now.
    pub fn handle_at(&self, slot: u32) -> Option<AnchorHandle> {
        match self.slots.get(slot as usize)? {
            AnchorSlot { generation, state: SlotState::Live(_) } => {
                Some(AnchorHandle { slot, generation: *generation })
            }
            _ => None,
        }
    }

    /// Every live anchor in slot order.
    pub fn iter(&self) -> impl Iterator<Item = (AnchorHandle, &AnchorRecord)> {
        self.slots.iter().zip(0u32..).filter_map(|(entry, slot)| match &entry.state {
            SlotState::Live(record) => Some((AnchorHandle { slot, generation: entry.generation }, record)),
            SlotState::Free { .. } => None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(keyframe_ordinal: u32) -> AnchorRecord {
        AnchorRecord { voxel: VoxelKey::default(), keyframe_ordinal, n_gaussians: 1, page_part: NOT_STORED }
    }

    fn ordinals(pool: &AnchorPool<&mut [AnchorSlot]>) -> std::vec::Vec<u32> {
        pool.iter().map(|(_, record)| record.keyframe_ordinal).collect()
    }

    #[test]
    fn the_third_anchor_is_refused_by_a_pool_of_two() {
        let mut slots = [AnchorSlot::EMPTY; 2];
        let mut pool = AnchorPool::new(slots.as_mut_slice());
        assert!(pool.insert(record(10)).is_ok() && pool.insert(record(20)).is_ok());
        assert_eq!(pool.insert(record(30)), Err(PoolFull { capacity: 2 }));
        assert_eq!(ordinals(&pool), [10, 20]);
    }

    #[test]
    fn a_handle_dies_with_its_anchor_even_when_the_slot_lives_again() {
        let mut slots = [AnchorSlot::EMPTY; 2];
        let mut pool = AnchorPool::new(slots.as_mut_slice());
        let first = pool.insert(record(10)).expect("empty pool");
        assert_eq!(pool.remove(first), Some(record(10)));
        let second = pool.insert(record(20)).expect("freed slot");
        assert_eq!((second.slot, second.generation), (first.slot, first.generation + 1));
        assert_eq!(pool.get(first), None);
        assert_eq!(pool.remove(first), None);
        assert_eq!(pool.get_mut(second).map(|r| r.keyframe_ordinal), Some(20));
        assert_eq!(pool.n_live(), 1);
    }

    #[test]
    fn a_pool_without_memory_refuses_everything() {
        let mut pool = AnchorPool::new([].as_mut_slice());
        assert_eq!(pool.insert(record(1)), Err(PoolFull { capacity: 0 }));
        assert_eq!(pool.handle_at(0), None);
    }
}
