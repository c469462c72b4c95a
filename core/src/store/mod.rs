//! Codecs of the map store: what a page, a chunk, a keyframe and the manifest look like as bytes.
//!
//! Everything on disk is a sequence of *records*: a fixed prefix (magic, kind, version, length, checksums)
//! and a body, little endian. Encoding goes into memory of the caller, decoding borrows it; a damaged record
//! is told apart as truncated, changed, of another version or not a record at all ([`RecordProblem`]).
//!
//! | file | records |
//! |---|---|
//! | page | [`PageLabel`], then one body of [`StoredAnchor`]s, each followed by its feature, if it has one, and its Gaussians |
//! | chunk | one: decoder parameters (kind tag and bytes) and the directional background table |
//! | keyframe log | one fixed-size record per keyframe or held-out view; the last one of a frame counts |
//! | manifest | one: camera, mounting, pixel format, levels, capacity, counts |

mod chunk;
mod feature;
mod keyframe;
mod manifest;
mod page;
mod record;

pub use chunk::{
    ChunkBackground, ChunkLabel, ChunkView, DecoderParams, chunk_record_bytes, decode_chunk, encode_chunk,
};
pub use feature::StoredFeature;
pub use keyframe::{KEYFRAME_RECORD_BYTES, StoredKeyframe, decode_keyframe, encode_keyframe};
pub use manifest::{MANIFEST_BYTES, MAX_LEVELS, Manifest, MapCounts, decode_manifest, encode_manifest};
pub use page::{
    PAGE_HEADER_BYTES, PageEncoder, PageFull, PageLabel, PageReader, StoredAnchor, decode_page, decode_page_label,
    page_anchors, page_file_bytes, page_length,
};
pub use record::{RecordProblem, STORE_VERSION};
