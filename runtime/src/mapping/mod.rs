//! From posed keyframes to a map of Gaussians: insertion, optimisation, pages that leave.
//!
//! The [`Mapper`] allocates at construction and never again. It holds the anchors near the vehicle; those of a
//! keyframe that is far behind leave as pages through a [`PageSink`]; [`render_views`](crate::render_views) brings
//! them back to look at the finished map.

pub mod capacity;
mod decoder;
mod depth;
mod depths;
mod evict;
mod given_views;
mod images;
mod insert;
mod list_load;
mod mapper;
mod optimize;
mod prune;
mod scratch;
mod settings;
mod shrink;
mod sink;

pub use capacity::MapperCapacity;
pub use evict::PAGE_KEYFRAMES;
pub use given_views::GivenView;
pub use images::MappingImage;
pub use list_load::{ListCount, ListLoad};
pub use mapper::{CHUNK_KEYFRAMES, InsertReport, KeyframePacket, MapCounters, MapRefusals, Mapper, PacketRefused};
pub use optimize::{MAX_OLDER_VIEWS, OptimizeReport};
pub(crate) use scratch::{NO_GAUSSIAN, NO_HEADER};
pub use settings::MapperSettings;
pub use shrink::{mapping_camera, shrink};
pub use sink::PageSink;

#[cfg(test)]
mod tests;
