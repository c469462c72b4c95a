//! A keyframe, or a held-out view, as the keyframe log stores it.

use super::record::{self, PREFIX_BYTES, RecordKind, RecordProblem};
use crate::conventions::TimestampNs;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout};

/// A view whose image is in the store and whose pose in the map is known.
///
/// The log may name a frame several times (a loop closure moved it); the last record counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StoredKeyframe {
    /// Keyframe id that anchors refer to; for a held-out view the keyframe that its pose was relative to.
    pub keyframe_id: u32,
    /// Chunk that the keyframe belongs to.
    pub chunk_id: u32,
    /// Index of the frame in its stream: unique in the log, names the image file.
    pub frame_index: u64,
    /// Middle of the exposure on the capture process's clock.
    pub timestamp_ns: TimestampNs,
    /// Rotation of `map_from_keyframe`, `[x, y, z, w]`.
    pub rotation_xyzw: [f64; 4],
    /// Translation of `map_from_keyframe`, m.
    pub translation_m: [f64; 3],
    /// Scale of `map_from_keyframe`.
    pub scale: f64,
    /// Never used in a loss; kept to judge the map by.
    pub is_held_out: bool,
    /// Length of the image file; 0 when the image was not stored.
    pub image_bytes: u32,
    /// Checksum of the image file.
    pub image_crc: u32,
}

#[derive(Clone, Copy, FromBytes, IntoBytes, Immutable, KnownLayout)]
#[repr(C)]
struct KeyframeBody {
    rotation_xyzw: [f64; 4],
    translation_m: [f64; 3],
    scale: f64,
    frame_index: u64,
    timestamp_ns: u64,
    keyframe_id: u32,
    chunk_id: u32,
    is_held_out: u32,
    image_bytes: u32,
    image_crc: u32,
    reserved: u32,
}

/// Every record of the keyframe log has this length, so that a damaged one can be stepped over.
pub const KEYFRAME_RECORD_BYTES: usize = PREFIX_BYTES + size_of::<KeyframeBody>();
const _: () = assert!(KEYFRAME_RECORD_BYTES == 128);

/// The record's bytes.
pub fn encode_keyframe(keyframe: &StoredKeyframe) -> [u8; KEYFRAME_RECORD_BYTES] {
    let body = KeyframeBody {
        rotation_xyzw: keyframe.rotation_xyzw,
        translation_m: keyframe.translation_m,
        scale: keyframe.scale,
        frame_index: keyframe.frame_index,
        timestamp_ns: keyframe.timestamp_ns,
        keyframe_id: keyframe.keyframe_id,
        chunk_id: keyframe.chunk_id,
        is_held_out: u32::from(keyframe.is_held_out),
        image_bytes: keyframe.image_bytes,
        image_crc: keyframe.image_crc,
        reserved: 0,
    };
    let mut bytes = [0; KEYFRAME_RECORD_BYTES];
    let written = record::write(RecordKind::Keyframe, &body, &mut bytes);
    debug_assert_eq!(written, Some(KEYFRAME_RECORD_BYTES));
    bytes
}

/// Verifies the record at the beginning of `bytes`.
///
/// # Errors
/// [`RecordProblem`] when it is damaged, or when its numbers are no similarity; step over it and report it.
pub fn decode_keyframe(bytes: &[u8]) -> Result<StoredKeyframe, RecordProblem> {
    let body: KeyframeBody = record::open_as(RecordKind::Keyframe, bytes)?;
    let finite = body.rotation_xyzw.iter().chain(&body.translation_m).all(|value| value.is_finite());
    let turns = body.rotation_xyzw.iter().any(|value| *value != 0.0);
    let scales = body.scale.is_finite() && body.scale > 0.0;
    if !finite || !turns || !scales || body.is_held_out > 1 {
        return Err(RecordProblem::Inconsistent { element: body.keyframe_id });
    }
    Ok(StoredKeyframe {
        keyframe_id: body.keyframe_id,
        chunk_id: body.chunk_id,
        frame_index: body.frame_index,
        timestamp_ns: body.timestamp_ns,
        rotation_xyzw: body.rotation_xyzw,
        translation_m: body.translation_m,
        scale: body.scale,
        is_held_out: body.is_held_out == 1,
        image_bytes: body.image_bytes,
        image_crc: body.image_crc,
    })
}

#[cfg(test)]
mod tests {
    use super::super::record::{STORE_VERSION, as_next_version, check_every_damage_is_noticed};
    use super::*;

    const KEYFRAME: StoredKeyframe = StoredKeyframe {
        keyframe_id: 12,
        chunk_id: 0,
        frame_index: 47,
        timestamp_ns: 4_700_000_000,
        rotation_xyzw: [0.0, 0.6, 0.0, 0.8],
        translation_m: [1.5, -0.25, 60.0],
        scale: 1.0,
        is_held_out: true,
        image_bytes: 90_000,
        image_crc: 0xdead_beef,
    };

    #[test]
    fn a_keyframe_comes_back_and_no_damage_passes() {
        let bytes = encode_keyframe(&KEYFRAME);
        assert_eq!(decode_keyframe(&bytes), Ok(KEYFRAME));
        check_every_damage_is_noticed(&bytes, |bytes| decode_keyframe(bytes).map(|_| ()));
        assert_eq!(decode_keyframe(&as_next_version(&bytes)), Err(RecordProblem::Version { found: STORE_VERSION + 1 }));
    }

    #[test]
    fn numbers_that_are_no_similarity_are_refused() {
        for keyframe in [
            StoredKeyframe { scale: 0.0, ..KEYFRAME },
            StoredKeyframe { scale: f64::INFINITY, ..KEYFRAME },
            StoredKeyframe { translation_m: [f64::NAN, 0.0, 0.0], ..KEYFRAME },
            StoredKeyframe { rotation_xyzw: [0.0; 4], ..KEYFRAME },
        ] {
            let verdict = decode_keyframe(&encode_keyframe(&keyframe));
            assert_eq!(verdict, Err(RecordProblem::Inconsistent { element: 12 }), "{keyframe:?}");
        }
    }
}
