//! Where every keyframe of the run is in the world: a table on disk that loop closures correct.

use super::OutputError;
use kilogs_core::conventions::{Rigid, TimestampNs, quaternion_xyzw, rotation_from_xyzw};
use nalgebra::Translation3;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use zerocopy::{FromBytes, FromZeros, Immutable, IntoBytes, KnownLayout};

/// A keyframe as it stands in the table.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct PlacedKeyframe {
    pub(super) timestamp_ns: TimestampNs,
    /// Whether it is a keyframe for people. Where tracking began anew, a doubtful frame carries those behind it.
    pub(super) is_tracked: bool,
    /// Rotation and position of the keyframe's camera.
    pub(super) world_from_keyframe: Rigid,
    /// Metres of the world per metre of what was measured relative to the keyframe.
    pub(super) scale: f64,
}

/// A scale of 0 marks a row that was never written.
#[derive(Clone, Copy, Debug, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Row {
    timestamp_ns: u64,
    is_tracked: u64,
    scale: f64,
    quaternion_xyzw: [f64; 4],
    position_m: [f64; 3],
}

const ROW_BYTES: usize = size_of::<Row>();

/// Rows that are read at once: frames that follow each other refer to keyframes that do.
const BLOCK_ROWS: usize = 256;

/// The table; keeps one block of rows in memory.
#[derive(Debug)]
pub(super) struct KeyframeTable {
    path: PathBuf,
    file: File,
    n_rows: u32,
    block: Box<[Row]>,
    block_start: Option<u32>,
}

impl KeyframeTable {
    pub(super) fn create(path: PathBuf) -> Result<Self, OutputError> {
        let options = File::options().read(true).write(true).create(true).truncate(true).open(&path);
        let file = options.map_err(OutputError::write(&path))?;
        let block = vec![Row::new_zeroed(); BLOCK_ROWS].into_boxed_slice();
        Ok(Self { path, file, n_rows: 0, block, block_start: None })
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// One above the largest ordinal that was placed.
    pub(super) fn len(&self) -> u32 {
        self.n_rows
    }

    /// Puts a keyframe into the table, replacing what was there.
    pub(super) fn place(&mut self, ordinal: u32, keyframe: &PlacedKeyframe) -> Result<(), OutputError> {
        let row = Row {
            timestamp_ns: keyframe.timestamp_ns,
            is_tracked: u64::from(keyframe.is_tracked),
            scale: keyframe.scale,
            quaternion_xyzw: quaternion_xyzw(&keyframe.world_from_keyframe.rotation),
            position_m: keyframe.world_from_keyframe.translation.vector.into(),
        };
        self.n_rows = self.n_rows.max(ordinal + 1);
        if self.block_start == Some(block_of(ordinal)) {
            self.block[(ordinal - block_of(ordinal)) as usize] = row;
        }
        self.file.write_all_at(row.as_bytes(), offset(ordinal)).map_err(OutputError::write(&self.path))
    }

    /// The keyframe, or `None` when it was never placed.
    pub(super) fn get(&mut self, ordinal: u32) -> Result<Option<PlacedKeyframe>, OutputError> {
        if ordinal >= self.n_rows {
            return Ok(None);
        }
        let block_start = block_of(ordinal);
        if self.block_start != Some(block_start) {
            let n_rows = BLOCK_ROWS.min((self.n_rows - block_start) as usize);
            self.block_start = None;
            self.block.fill(Row::new_zeroed());
            let bytes = self.block[..n_rows].as_mut_bytes();
            self.file.read_exact_at(bytes, offset(block_start)).map_err(OutputError::read_back(&self.path))?;
            self.block_start = Some(block_start);
        }
        let row = &self.block[(ordinal - block_start) as usize];
        let placed = PlacedKeyframe {
            timestamp_ns: row.timestamp_ns,
            is_tracked: row.is_tracked != 0,
            world_from_keyframe: Rigid::from_parts(
                Translation3::from(row.position_m),
                rotation_from_xyzw(row.quaternion_xyzw),
            ),
            scale: row.scale,
        };
        Ok((row.scale != 0.0).then_some(placed))
    }
}

/// First ordinal of the block that holds `ordinal`.
fn block_of(ordinal: u32) -> u32 {
    ordinal - ordinal % BLOCK_ROWS as u32
}

fn offset(ordinal: u32) -> u64 {
    u64::from(ordinal) * ROW_BYTES as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keyframe(k: u32) -> PlacedKeyframe {
        let world_from_keyframe = Rigid::translation(f64::from(k), 0.0, 1.0);
        PlacedKeyframe {
            timestamp_ns: u64::from(k) * 7,
            is_tracked: !k.is_multiple_of(3),
            world_from_keyframe,
            scale: 1.0,
        }
    }

    #[test]
    fn rows_are_found_across_blocks_and_after_a_correction() {
        let folder = tempfile::tempdir().expect("temporary folder");
        let mut table = KeyframeTable::create(folder.path().join("table")).expect("created");
        for k in (0..600).filter(|&k| k != 300) {
            table.place(k, &keyframe(k)).expect("placed");
        }
        for k in [599, 0, 255, 256, 1, 511, 512] {
            assert_eq!(table.get(k).expect("read"), Some(keyframe(k)));
        }
        assert_eq!(table.get(300).expect("read"), None, "never placed");
        assert_eq!(table.get(600).expect("read"), None, "beyond the end");
        let corrected = PlacedKeyframe { scale: 1.1, ..keyframe(9) };
        table.place(512, &corrected).expect("placed");
        assert_eq!(table.get(512).expect("read"), Some(corrected));
        table.place(603, &keyframe(603)).expect("placed behind a gap");
        assert_eq!(table.get(603).expect("read"), Some(keyframe(603)));
        assert_eq!(table.get(601).expect("read"), None, "the gap");
        assert_eq!((table.len(), table.get(513).expect("read")), (604, Some(keyframe(513))));
    }
}
