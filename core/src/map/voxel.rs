//! The hierarchical voxel grid: which voxel a point falls into, and which anchor stands for it.

use super::lod::{N_LEVELS, VOXEL_SIZES_M};
use core::fmt;
use core::ops::DerefMut;

/// Bits of one axis; at 0.1 m they reach 52 km either way.
const AXIS_BITS: u32 = 20;
const AXIS_OFFSET: i64 = 1 << (AXIS_BITS - 1);
const AXIS_MASK: u64 = (1 << AXIS_BITS) - 1;

/// Level and integer coordinates of a voxel in the map frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default)]
pub struct VoxelKey(u64);

impl VoxelKey {
    /// Voxel of `level` that contains a point: `floor(x / eps)` per axis; `None` for a level that does not
    /// exist, a point that is not finite, or one farther than 2^19 voxels from the map's origin.
    pub fn containing(level: u8, point_in_map_m: [f64; 3]) -> Option<Self> {
        let size_m = f64::from(*VOXEL_SIZES_M.get(level as usize)?);
        let mut packed = u64::from(level);
        for coordinate_m in point_in_map_m {
            let index = libm::floor(coordinate_m / size_m);
            if !(-(AXIS_OFFSET as f64) <= index && index < AXIS_OFFSET as f64) {
                return None;
            }
            packed = (packed << AXIS_BITS) | (index as i64 + AXIS_OFFSET) as u64;
        }
        Some(Self(packed))
    }

    /// Level of the voxel, 0 the finest.
    pub fn level(self) -> u8 {
        (self.0 >> (3 * AXIS_BITS)) as u8
    }

    /// Centre of the voxel, m: `(floor(x / eps) + 1/2) eps`.
    pub fn center_in_map_m(self) -> [f64; 3] {
        let size_m = VOXEL_SIZES_M.get(self.level() as usize).copied().map_or(0.0, f64::from);
        [2, 1, 0].map(|axis| {
            let index = ((self.0 >> (axis * AXIS_BITS)) & AXIS_MASK) as i64 - AXIS_OFFSET;
            (index as f64 + 0.5) * size_m
        })
    }

    /// Edge of the voxel, m.
    pub fn size_m(self) -> f32 {
        VOXEL_SIZES_M.get(self.level() as usize).copied().unwrap_or(0.0)
    }

    /// Spreads neighbouring voxels over the table (finaliser of Steele, Lea & Flood 2014).
    fn hash(self) -> usize {
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as usize
    }
}

const _: () = assert!(N_LEVELS <= 8, "three bits are left for the level above the axes");

/// One entry of the grid's memory.
#[derive(Debug, Clone, Copy)]
pub struct VoxelCell {
    key: VoxelKey,
    slot: u32,
}

impl VoxelCell {
    /// An unused cell; fill the grid's memory with it.
    pub const EMPTY: Self = Self { key: VoxelKey(0), slot: VACANT };
}

const VACANT: u32 = u32::MAX;

/// The voxel grid holds as many voxels as it may.
///
/// Give it at least a third more cells than the anchor pool has slots; the caller skips the insertion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GridFull {
    /// Voxels that the grid may hold.
    pub capacity: u32,
}

impl fmt::Display for GridFull {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "all {} voxels of the grid are in use", self.capacity)
    }
}

impl core::error::Error for GridFull {}

/// Spatial hash from voxels to anchor slots; linear probing, deletion by shifting back, no tombstones.
///
/// # Source
/// Knuth 1998, "Sorting and Searching", section 6.4, algorithms L and R. Own implementation.
#[derive(Debug)]
pub struct VoxelGrid<S> {
    cells: S,
    n_used: usize,
}

impl<S: DerefMut<Target = [VoxelCell]>> VoxelGrid<S> {
    /// Builds an empty grid; it holds at most three quarters of the cells, so that probes stay short.
    pub fn new(cells: S) -> Self {
        let mut grid = Self { cells, n_used: 0 };
        grid.clear();
        grid
    }

    /// Forgets every voxel.
    pub fn clear(&mut self) {
        self.cells.fill(VoxelCell::EMPTY);
        self.n_used = 0;
    }

    /// Voxels that the grid may hold.
    pub fn capacity(&self) -> usize {
        self.cells.len() - self.cells.len() / 4
    }

    /// Voxels in the grid.
    pub fn len(&self) -> usize {
        self.n_used
    }

    /// Whether no voxel is in the grid.
    pub fn is_empty(&self) -> bool {
        self.n_used == 0
    }

    /// Slot of the anchor that stands for the voxel.
    pub fn get(&self, key: VoxelKey) -> Option<u32> {
        self.cells.get(self.find(key)?).map(|cell| cell.slot).filter(|&slot| slot != VACANT)
    }

    /// Makes `slot` stand for the voxel; replaces what stood there.
    ///
    /// # Errors
    /// [`GridFull`] when the voxel is new and the grid holds as many as it may.
    pub fn insert(&mut self, key: VoxelKey, slot: u32) -> Result<(), GridFull> {
        let full = GridFull { capacity: self.capacity() as u32 };
        let is_full = self.n_used >= self.capacity();
        let Some(cell) = self.find(key).and_then(|at| self.cells.get_mut(at)) else { return Err(full) };
        if cell.slot == VACANT {
            if is_full {
                return Err(full);
            }
            self.n_used += 1;
        }
        *cell = VoxelCell { key, slot };
        Ok(())
    }

    /// Frees the voxel; gives back the slot that stood for it.
    pub fn remove(&mut self, key: VoxelKey) -> Option<u32> {
        let mut hole = self.find(key)?;
        let removed = self.cells.get(hole).map(|cell| cell.slot).filter(|&slot| slot != VACANT)?;
        let n = self.cells.len();
        let mut next = hole;
        loop {
            next = (next + 1) % n;
            let Some(&cell) = self.cells.get(next) else { break };
            if cell.slot == VACANT {
                break;
            }
            // The entry may move back only if its probe starts at or before the hole.
            let from_home_to_next = (next + n - cell.key.hash() % n) % n;
            let from_hole_to_next = (next + n - hole) % n;
            if from_home_to_next >= from_hole_to_next {
                self.cells.swap(hole, next);
                hole = next;
            }
        }
        if let Some(cell) = self.cells.get_mut(hole) {
            *cell = VoxelCell::EMPTY;
        }
        self.n_used -= 1;
        Some(removed)
    }

    /// Cell of the key, or the vacant cell where it would go; `None` only without memory.
    fn find(&self, key: VoxelKey) -> Option<usize> {
        let n = self.cells.len();
        let mut at = key.hash().checked_rem(n)?;
        // At least a quarter of the cells is vacant, so the walk ends.
        for _ in 0..n {
            match self.cells.get(at) {
                Some(cell) if cell.slot != VACANT && cell.key != key => at = (at + 1) % n,
                _ => return Some(at),
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use std::collections::BTreeMap;

    #[test]
    fn a_point_falls_into_the_voxel_whose_centre_is_nearest() {
        let cases = [
            (0, [0.05, 0.0, 0.099], [0.05, 0.05, 0.05]),
            (0, [-0.01, -0.11, 0.11], [-0.05, -0.15, 0.15]),
            (2, [-0.5, 1.0, 2.999], [-0.5, 1.5, 2.5]),
            (4, [24.9, -0.1, 25.1], [12.5, -12.5, 37.5]),
        ];
        for (level, point_m, center_m) in cases {
            let key = VoxelKey::containing(level, point_m).expect("in range");
            assert_eq!(key.level(), level);
            for (found, expected) in key.center_in_map_m().iter().zip(center_m) {
                assert!((found - expected).abs() < 1e-6, "{point_m:?}: {found} is not {expected}");
            }
        }
    }

    #[test]
    fn points_out_of_range_have_no_voxel() {
        for (level, x_m) in [(0, 52_430.0), (0, f64::NAN), (0, f64::INFINITY), (5, 0.0), (4, -13_200_000.0)] {
            assert_eq!(VoxelKey::containing(level, [x_m, 0.0, 0.0]), None, "level {level}, {x_m} m");
        }
    }

    #[test]
    fn a_small_grid_agrees_with_a_map_through_ten_thousand_changes() {
        let mut cells = [VoxelCell::EMPTY; 16];
        let mut grid = VoxelGrid::new(cells.as_mut_slice());
        let mut expected = BTreeMap::new();
        let mut rng = Rng::new(1, 2, 3);
        for step in 0..10_000u32 {
            let x_m = rng.below(20) as f64 * 0.1 + 0.05;
            let key = VoxelKey::containing(0, [x_m, 0.0, 0.0]).expect("in range");
            if rng.below(2) == 0 {
                let fits = expected.len() < 12 || expected.contains_key(&key);
                assert_eq!(grid.insert(key, step).is_ok(), fits);
                if fits {
                    expected.insert(key, step);
                }
            } else {
                assert_eq!(grid.remove(key), expected.remove(&key));
            }
            assert_eq!((grid.get(key), grid.len()), (expected.get(&key).copied(), expected.len()));
        }
        assert!(expected.iter().all(|(&key, &slot)| grid.get(key) == Some(slot)));
    }

    #[test]
    fn a_grid_without_memory_refuses() {
        let mut grid = VoxelGrid::new([].as_mut_slice());
        let key = VoxelKey::containing(0, [0.0; 3]).expect("in range");
        assert_eq!(grid.insert(key, 1), Err(GridFull { capacity: 0 }));
        assert_eq!((grid.get(key), grid.remove(key)), (None, None));
    }
}
