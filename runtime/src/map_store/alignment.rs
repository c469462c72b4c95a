//! Where loops have moved the keyframes of a map: a file beside the log of keyframes, replaced as a whole.
//!
//! The log says where each keyframe was when it was mapped and is only appended to. So moving a map is one small file that
//! is there whole or not at all, and no record, page or image is touched.

use super::{StoreError, layout};
use kilogs_core::conventions::{Rigid, Similarity, quaternion_xyzw, rotation_from_xyzw};
use kilogs_core::store::{RecordProblem, StoredKeyframe};
use nalgebra::{Translation3, Vector3};
use std::path::Path;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// First bytes of the file.
const MAGIC: [u8; 4] = *b"KGSa";
/// Version of the file.
const VERSION: u32 = 1;

/// Moves of all keyframes of a map, by keyframe. Empty: nothing has moved.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Alignment {
    /// First keyframe that moves like this, ascending.
    steps: Vec<(u32, Similarity)>,
}

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Header {
    magic: [u8; 4],
    version: u32,
    n_steps: u32,
    steps_crc: u32,
}

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Step {
    first_keyframe_id: u64,
    rotation_xyzw: [f64; 4],
    translation_m: [f64; 3],
    scale: f64,
}

impl Alignment {
    /// Bytes in memory for each keyframe that moves unlike the one before.
    pub const BYTES_PER_STEP: usize = size_of::<(u32, Similarity)>();

    /// Takes the memory of `n_steps` steps.
    pub fn with_capacity(n_steps: usize) -> Self {
        Self { steps: Vec::with_capacity(n_steps) }
    }

    /// Whether nothing has moved.
    pub fn is_empty(&self) -> bool {
        self.steps.is_empty()
    }

    /// How a keyframe, and every frame that hangs on it, moves: `map_from_unaligned`. A keyframe that nothing is said about
    /// moves with the one before it.
    pub fn at(&self, keyframe_id: u32) -> Similarity {
        let after = self.steps.partition_point(|(first, _)| *first <= keyframe_id);
        after.checked_sub(1).map_or_else(Similarity::identity, |last| self.steps[last].1)
    }

    /// How whatever comes next moves.
    pub fn newest(&self) -> Similarity {
        self.at(u32::MAX)
    }

    /// Takes over what another one says; takes memory only where there is too little.
    pub fn copy_from(&mut self, other: &Self) {
        self.steps.clone_from(&other.steps);
    }

    /// Takes over what is said about earlier keyframes; the drive that begins with `first_keyframe_id` has not moved.
    pub fn go_on_after(&mut self, earlier: &Self, first_keyframe_id: u32) {
        self.steps.clone_from(&earlier.steps);
        self.truncate_from(first_keyframe_id);
        self.push(first_keyframe_id, Similarity::identity());
    }

    /// Forgets what was said about a keyframe and those behind it.
    pub fn truncate_from(&mut self, keyframe_id: u32) {
        self.steps.truncate(self.steps.partition_point(|(first, _)| *first < keyframe_id));
    }

    /// Says how the next keyframe and those behind it move.
    pub fn push(&mut self, first_keyframe_id: u32, map_from_unaligned: Similarity) {
        if self.newest() != map_from_unaligned {
            self.steps.push((first_keyframe_id, map_from_unaligned));
        }
    }

    /// Moves a keyframe, or a view that hangs on one.
    pub(super) fn apply(&self, view: &mut StoredKeyframe) {
        let moved = self.at(view.keyframe_id) * placed(view.rotation_xyzw, view.translation_m, view.scale);
        view.rotation_xyzw = quaternion_xyzw(&moved.isometry.rotation);
        view.translation_m = moved.isometry.translation.vector.into();
        view.scale = moved.scaling();
    }

    /// Replaces the alignment of the map in `folder`. Whatever ends the process, it is the old or the new one.
    ///
    /// # Errors
    /// [`StoreError::Write`].
    pub fn write(&self, folder: &Path) -> Result<(), StoreError> {
        let step = |(first, moved): &(u32, Similarity)| Step {
            first_keyframe_id: (*first).into(),
            rotation_xyzw: quaternion_xyzw(&moved.isometry.rotation),
            translation_m: moved.isometry.translation.vector.into(),
            scale: moved.scaling(),
        };
        let steps: Vec<Step> = self.steps.iter().map(step).collect();
        let n_steps = u32::try_from(steps.len()).unwrap_or(u32::MAX);
        let steps_crc = crc32fast::hash(steps.as_bytes());
        let header = Header { magic: MAGIC, version: VERSION, n_steps, steps_crc };
        layout::replace_file(&folder.join(layout::ALIGNMENT), &[header.as_bytes(), steps.as_bytes()].concat())
    }

    /// The alignment of the map in `folder`; without a file nothing has moved.
    ///
    /// # Errors
    /// [`StoreError::Read`]. Inside: what is wrong with the file.
    pub fn read(folder: &Path) -> Result<Result<Self, RecordProblem>, StoreError> {
        let path = folder.join(layout::ALIGNMENT);
        match std::fs::read(&path) {
            Ok(bytes) => Ok(decode(&bytes)),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(Ok(Self::default())),
            Err(error) => Err(StoreError::read("opening", &path, error)),
        }
    }
}

fn decode(bytes: &[u8]) -> Result<Alignment, RecordProblem> {
    let saturate = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    let truncated = |needed: usize| RecordProblem::Truncated { found: saturate(bytes.len()), needed: saturate(needed) };
    let (header, rest) = Header::read_from_prefix(bytes).map_err(|_| truncated(size_of::<Header>()))?;
    if header.magic != MAGIC {
        return Err(RecordProblem::NotThisRecord { wanted_kind: u32::from_le_bytes(MAGIC), found_kind: 0 });
    }
    if header.version != VERSION {
        return Err(RecordProblem::Version { found: header.version });
    }
    let n_bytes = (header.n_steps as usize).saturating_mul(size_of::<Step>());
    let steps = rest.get(..n_bytes).ok_or_else(|| truncated(n_bytes.saturating_add(size_of::<Header>())))?;
    let computed_crc = crc32fast::hash(steps);
    if computed_crc != header.steps_crc {
        return Err(RecordProblem::Changed { stored_crc: header.steps_crc, computed_crc });
    }
    let read = |chunk: &[u8]| {
        let step = Step::read_from_bytes(chunk).ok()?;
        let moved = placed(step.rotation_xyzw, step.translation_m, step.scale);
        let is_usable = step.scale > 0.0 && step.scale.is_finite() && step.translation_m.iter().all(|m| m.is_finite());
        Some((u32::try_from(step.first_keyframe_id).ok()?, moved)).filter(|_| is_usable)
    };
    let mut alignment = Alignment::default();
    for (element, chunk) in steps.chunks_exact(size_of::<Step>()).enumerate() {
        let follows = |first: u32| alignment.steps.last().is_none_or(|(last, _)| *last < first);
        match read(chunk).filter(|(first, _)| follows(*first)) {
            Some(step) => alignment.steps.push(step),
            None => return Err(RecordProblem::Inconsistent { element: saturate(element) }),
        }
    }
    Ok(alignment)
}

fn placed(rotation_xyzw: [f64; 4], translation_m: [f64; 3], scale: f64) -> Similarity {
    let translation = Translation3::from(Vector3::from(translation_m));
    Similarity::from_isometry(Rigid::from_parts(translation, rotation_from_xyzw(rotation_xyzw)), scale)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moved(x_m: f64, yaw_rad: f64, scale: f64) -> Similarity {
        let translation = Translation3::new(x_m, 0.0, -2.0);
        let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::y() * yaw_rad);
        Similarity::from_isometry(Rigid::from_parts(translation, turn), scale)
    }

    fn example() -> Alignment {
        let mut alignment = Alignment::with_capacity(4);
        for (first, move_m) in [(3, 0.0), (5, 1.0), (6, 1.0), (9, 2.0)] {
            alignment.push(first, moved(move_m, 0.1 * move_m, 1.0 + 0.1 * move_m));
        }
        alignment
    }

    #[test]
    fn a_keyframe_moves_with_the_last_one_that_something_is_said_about() {
        let mut alignment = example();
        let check =
            |alignment: &Alignment, id: u32, expected: Similarity| assert_eq!(alignment.at(id), expected, "{id}");
        for (id, expected) in [
            (0, Similarity::identity()),
            (2, Similarity::identity()),
            (3, moved(0.0, 0.0, 1.0)),
            (5, moved(1.0, 0.1, 1.1)),
            (8, moved(1.0, 0.1, 1.1)),
            (9, moved(2.0, 0.2, 1.2)),
            (70, moved(2.0, 0.2, 1.2)),
        ] {
            check(&alignment, id, expected);
        }
        assert_eq!(alignment.steps.len(), 3, "6 moves like 5");
        alignment.truncate_from(9);
        check(&alignment, 70, moved(1.0, 0.1, 1.1));
    }

    #[test]
    fn a_file_comes_back_as_it_was_written_and_every_damage_is_noticed() {
        let folder = tempfile::tempdir().expect("a folder");
        assert_eq!(Alignment::read(folder.path()).expect("no file"), Ok(Alignment::default()));
        let alignment = example();
        alignment.write(folder.path()).expect("written");
        let read = Alignment::read(folder.path()).expect("read").expect("whole");
        for id in 0..12 {
            let difference = read.at(id).to_homogeneous() - alignment.at(id).to_homogeneous();
            assert!(difference.norm() < 1e-12, "{id}");
        }
        let path = folder.path().join(layout::ALIGNMENT);
        let bytes = std::fs::read(&path).expect("the file");
        for place in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[place] ^= 4;
            assert!(decode(&changed).is_err(), "byte {place}");
            assert!(decode(&bytes[..place]).is_err(), "{place} bytes");
        }
    }
}
