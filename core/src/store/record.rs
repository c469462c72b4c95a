//! The frame around every stored record: what it is, how long, and whether it is still what was written.

use core::fmt;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// Version of the store that is written.
///
/// 2: anchors may have features, and chunks a learned decoder. 1: neither; such records are still read.
pub const STORE_VERSION: u32 = 2;

/// Oldest version that is read.
const OLDEST_VERSION: u32 = 1;

/// Bytes in front of every body.
pub(super) const PREFIX_BYTES: usize = size_of::<Prefix>();

const MAGIC: [u8; 4] = *b"KGSr";

// Bodies are read and written as they lie in memory.
const _: () = assert!(cfg!(target_endian = "little"), "the map store is little endian");

/// What a record holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u32)]
pub(super) enum RecordKind {
    PageLabel = 1,
    PageBody = 2,
    Chunk = 3,
    Keyframe = 4,
    Manifest = 5,
}

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct Prefix {
    magic: [u8; 4],
    kind: u32,
    version: u32,
    body_bytes: u32,
    body_crc: u32,
    /// Checksum of the fields above, so that a length or a version is believed only when it was written so.
    prefix_crc: u32,
}
const _: () = assert!(size_of::<Prefix>() == 24);

const PREFIX_CHECKED_BYTES: usize = size_of::<Prefix>() - size_of::<u32>();

/// Why stored bytes are not the record they should be. The caller skips the record and reports it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordProblem {
    /// The file ends before the record does: writing was interrupted, or the tail is lost.
    Truncated {
        /// Bytes that are there.
        found: u32,
        /// Bytes that the record needs.
        needed: u32,
    },
    /// Bytes differ from what was written: the medium or a program changed them.
    Changed {
        /// Checksum stored with the record.
        stored_crc: u32,
        /// Checksum of the bytes as they are.
        computed_crc: u32,
    },
    /// Written by a newer version of the program: convert the map or use that version.
    Version {
        /// Version of the record.
        found: u32,
    },
    /// Not a record of the kind that was asked for: the file is something else, or lost its beginning.
    NotThisRecord {
        /// The kind that was asked for, by number.
        wanted_kind: u32,
        /// The kind that the bytes claim, or 0 when they do not even start like a record.
        found_kind: u32,
    },
    /// The checksum is right and the content contradicts itself: a defect of the program that wrote it.
    Inconsistent {
        /// Ordinal of the element that is wrong.
        element: u32,
    },
}

impl fmt::Display for RecordProblem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated { found, needed } => write!(f, "truncated: {found} of {needed} bytes are there"),
            Self::Changed { stored_crc, computed_crc } => {
                write!(f, "bytes were changed: checksum is {computed_crc:08x}, {stored_crc:08x} was stored")
            }
            Self::Version { found } => {
                write!(f, "written as version {found}, this program reads {OLDEST_VERSION} to {STORE_VERSION}")
            }
            Self::NotThisRecord { wanted_kind, found_kind: 0 } => {
                write!(f, "does not start like a record (kind {wanted_kind} expected)")
            }
            Self::NotThisRecord { wanted_kind, found_kind } => {
                write!(f, "is a record of kind {found_kind}, kind {wanted_kind} expected")
            }
            Self::Inconsistent { element } => write!(f, "content contradicts itself at element {element}"),
        }
    }
}

impl core::error::Error for RecordProblem {}

/// Completes the record whose body already lies at `PREFIX_BYTES..PREFIX_BYTES + body_bytes` of `record`.
///
/// `None` when `record` is shorter than that or the body longer than a length can say.
pub(super) fn seal(kind: RecordKind, record: &mut [u8], body_bytes: usize) -> Option<usize> {
    let end = PREFIX_BYTES.checked_add(body_bytes)?;
    let body_crc = crc32fast::hash(record.get(PREFIX_BYTES..end)?);
    let mut prefix = Prefix {
        magic: MAGIC,
        kind: kind as u32,
        version: STORE_VERSION,
        body_bytes: u32::try_from(body_bytes).ok()?,
        body_crc,
        prefix_crc: 0,
    };
    prefix.prefix_crc = prefix_crc(&prefix);
    record.get_mut(..PREFIX_BYTES)?.copy_from_slice(prefix.as_bytes());
    Some(end)
}

/// Writes a whole record with `body` into `record`; `None` when it does not fit.
pub(super) fn write<T: IntoBytes + Immutable>(kind: RecordKind, body: &T, record: &mut [u8]) -> Option<usize> {
    let bytes = body.as_bytes();
    record.get_mut(PREFIX_BYTES..PREFIX_BYTES + bytes.len())?.copy_from_slice(bytes);
    seal(kind, record, bytes.len())
}

/// Body of the record at the beginning of `bytes`, verified.
pub(super) fn open(kind: RecordKind, bytes: &[u8]) -> Result<&[u8], RecordProblem> {
    let prefix = open_prefix(kind, bytes)?;
    let needed = PREFIX_BYTES.saturating_add(prefix.body_bytes as usize);
    let body = bytes.get(PREFIX_BYTES..needed).ok_or_else(|| truncated(bytes.len(), needed))?;
    let computed_crc = crc32fast::hash(body);
    if computed_crc != prefix.body_crc {
        return Err(RecordProblem::Changed { stored_crc: prefix.body_crc, computed_crc });
    }
    Ok(body)
}

/// A record whose body is exactly one `T`.
pub(super) fn open_as<T: FromBytes>(kind: RecordKind, bytes: &[u8]) -> Result<T, RecordProblem> {
    let body = open(kind, bytes)?;
    T::read_from_bytes(body).map_err(|_| RecordProblem::Inconsistent { element: 0 })
}

fn open_prefix(kind: RecordKind, bytes: &[u8]) -> Result<Prefix, RecordProblem> {
    let wanted_kind = kind as u32;
    let Ok((prefix, _)) = Prefix::read_from_prefix(bytes) else {
        return Err(truncated(bytes.len(), PREFIX_BYTES));
    };
    if prefix.magic != MAGIC {
        return Err(RecordProblem::NotThisRecord { wanted_kind, found_kind: 0 });
    }
    let computed_crc = prefix_crc(&prefix);
    if computed_crc != prefix.prefix_crc {
        return Err(RecordProblem::Changed { stored_crc: prefix.prefix_crc, computed_crc });
    }
    if !(OLDEST_VERSION..=STORE_VERSION).contains(&prefix.version) {
        return Err(RecordProblem::Version { found: prefix.version });
    }
    if prefix.kind != wanted_kind {
        return Err(RecordProblem::NotThisRecord { wanted_kind, found_kind: prefix.kind });
    }
    Ok(prefix)
}

fn prefix_crc(prefix: &Prefix) -> u32 {
    crc32fast::hash(prefix.as_bytes().get(..PREFIX_CHECKED_BYTES).unwrap_or_default())
}

pub(super) fn truncated(found: usize, needed: usize) -> RecordProblem {
    let saturate = |bytes: usize| u32::try_from(bytes).unwrap_or(u32::MAX);
    RecordProblem::Truncated { found: saturate(found), needed: saturate(needed) }
}

/// Test helper: every single-bit change and every shortening of `record` must be noticed by `decodes`.
#[cfg(test)]
pub(super) fn check_every_damage_is_noticed(record: &[u8], decodes: impl Fn(&[u8]) -> Result<(), RecordProblem>) {
    assert_eq!(decodes(record), Ok(()), "the undamaged record");
    let mut damaged = record.to_vec();
    for byte in 0..record.len() {
        for bit in 0..8 {
            damaged[byte] ^= 1 << bit;
            let verdict = decodes(&damaged);
            let noticed = matches!(
                verdict,
                Err(RecordProblem::Changed { .. } | RecordProblem::NotThisRecord { found_kind: 0, .. })
            );
            assert!(noticed, "byte {byte} bit {bit}: {verdict:?}");
            damaged[byte] ^= 1 << bit;
        }
    }
    for length in 0..record.len() {
        let verdict = decodes(&record[..length]);
        assert!(matches!(verdict, Err(RecordProblem::Truncated { .. })), "cut to {length} bytes: {verdict:?}");
    }
}

/// Length of the record at the beginning of `bytes`, which may end within its body.
pub(super) fn length(kind: RecordKind, bytes: &[u8]) -> Result<usize, RecordProblem> {
    open_prefix(kind, bytes).map(|prefix| PREFIX_BYTES.saturating_add(prefix.body_bytes as usize))
}

/// Test helper: the record as the next version of the program would write it.
#[cfg(test)]
pub(super) fn as_next_version(record: &[u8]) -> std::vec::Vec<u8> {
    as_version(STORE_VERSION + 1, record)
}

/// Test helper: the record with another version in its prefix.
#[cfg(test)]
pub(super) fn as_version(version: u32, record: &[u8]) -> std::vec::Vec<u8> {
    let (mut prefix, _) = Prefix::read_from_prefix(record).expect("a whole prefix");
    prefix.version = version;
    prefix.prefix_crc = prefix_crc(&prefix);
    let mut copy = record.to_vec();
    copy[..PREFIX_BYTES].copy_from_slice(prefix.as_bytes());
    copy
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_of_another_kind_and_foreign_bytes_are_told_apart() {
        let mut record = [0; 64];
        let length = write(RecordKind::Chunk, &7u64, &mut record).expect("64 bytes hold it");
        let asked = open(RecordKind::Manifest, &record[..length]);
        assert_eq!(asked, Err(RecordProblem::NotThisRecord { wanted_kind: 5, found_kind: 3 }));
        let foreign = open(RecordKind::Manifest, b"ply\nformat binary_little_endian 1.0\n");
        assert_eq!(foreign, Err(RecordProblem::NotThisRecord { wanted_kind: 5, found_kind: 0 }));
    }

    #[test]
    fn another_version_is_not_mistaken_for_damage() {
        let mut record = [0; 64];
        let length = write(RecordKind::Chunk, &7u64, &mut record).expect("64 bytes hold it");
        let newer = as_next_version(&record[..length]);
        assert_eq!(open(RecordKind::Chunk, &newer), Err(RecordProblem::Version { found: STORE_VERSION + 1 }));
        let too_old = as_version(OLDEST_VERSION - 1, &record[..length]);
        assert_eq!(open(RecordKind::Chunk, &too_old), Err(RecordProblem::Version { found: OLDEST_VERSION - 1 }));
        assert!(open(RecordKind::Chunk, &as_version(OLDEST_VERSION, &record[..length])).is_ok());
    }

    #[test]
    fn a_record_that_does_not_fit_is_not_begun() {
        assert_eq!(write(RecordKind::Chunk, &7u64, &mut [0; PREFIX_BYTES + 7]), None);
    }
}
