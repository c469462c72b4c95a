//! The map on disk.
//!
//! ```text
//! map/manifest.kgs           camera, capacity, counts; replaced atomically; counts only once the map is complete
//! map/keyframes.kgs          log of fixed-size records, keyframes and held-out views; the last one of a frame counts
//! map/alignment.kgs          how loops have moved keyframes since; not there when nothing moved; replaced atomically
//! map/places.kgs             by what its keyframes are recognized; rewritten in place, each of them with its checksum
//! map/pages/00000012.kgs     one page per file, replaced atomically: a page is there whole or not at all
//! map/chunks/00000001.kgs    one chunk (decoder, background) per file, replaced atomically
//! map/images/00000047.jpg    the camera image of frame 47; its length and checksum are in the keyframe log
//! ```
//!
//! Nothing in it tells when or where it was made: the same input gives the same bytes. Records are described in
//! [`kilogs_core::store`]. Writing happens on a thread of its own behind a queue of fixed size; a reader needs no
//! index and finds in an interrupted store everything that was completed.

mod alignment;
mod editor;
mod error;
mod held_out;
mod jpeg;
mod layout;
mod picture_rule;
mod queue;
mod read_back;
mod reader;
mod scan;
mod worker;
mod writer;

#[cfg(test)]
mod tests;

pub use alignment::Alignment;
pub use editor::MapStoreEditor;
pub use error::{Damage, DamageKind, StoreError};
pub use held_out::{HELD_OUT_PERIOD, HeldOutRule, is_held_out_frame};
pub(crate) use layout::places_path;
pub use picture_rule::PictureRule;
pub use read_back::{ReadFile, StoredFile};
pub use reader::{MapStoreReader, StoreBytes};
pub use writer::{
    DEFAULT_JPEG_QUALITY, MapStoreWriter, PageDraft, StoreCapacity, StoreImage, StoreSettings, StoreSummary, WhenBusy,
    WriteRefusal,
};
#[cfg(test)]
mod fault_tests;
