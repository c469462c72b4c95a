//! From posed keyframes to a map of Gaussians: insertion, optimisation, pages that leave.
//!
//! The [`Mapper`] allocates at construction and never again. It holds the anchors near the vehicle; those of a
//! keyframe that is far behind leave as pages through a [`PageSink`], and come back through a [`PageSource`] when the
//! vehicle is there again.

pub mod capacity;
mod decoder;
mod depth;
mod depths;
mod bring;
mod evict;
mod fingerprint;
mod given_views;
mod images;
mod in_the_way;
mod insert;
mod list_load;
mod mapper;
mod optimize;
mod pages;
mod paging;
mod prune;
mod realign;
mod scratch;
mod resume;
mod revisit;
mod settings;
mod shrink;
mod sides;
mod sink;
mod sky;

pub use capacity::MapperCapacity;
pub use given_views::GivenView;
pub use images::MappingImage;
pub use list_load::{ListCount, ListLoad};
pub use mapper::{CHUNK_KEYFRAMES, InsertReport, KeyframePacket, MapCounters, MapRefusals, Mapper, PacketRefused};
pub use optimize::{MAX_OLDER_VIEWS, OptimizeReport};
pub use pages::PAGE_KEYFRAMES;
pub use paging::TableLoad;
pub(crate) use prune::{PruneLimits, keep_those, without_residual};
pub use resume::first_keyframe_id_after;
pub(crate) use scratch::{NO_GAUSSIAN, NO_HEADER};
pub use settings::MapperSettings;
pub use shrink::{mapping_camera, shrink};
pub use sink::{PageSink, PageSource};

#[cfg(test)]
mod tests;
