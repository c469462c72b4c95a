//! What a run leaves behind: trajectories, one row per frame, figures, pictures.
//!
//! Everything is streamed in buffers of fixed size. A frame's pose is logged relative to its keyframe and turned
//! into a trajectory once, at the end, when the keyframes are where loop closures put them; so the memory taken
//! does not depend on the route.

mod error;
mod number;
mod sink;
mod stage_times;

mod frame_log;
mod frame_row;
mod keyframe_table;
mod trajectory;

mod folder;
mod loop_table;

mod publish;

mod drive_chart;
mod histogram;
pub mod report;

mod html;
mod renders;
mod view_table;

pub use drive_chart::{DriveBucket, DriveChart};
pub use error::OutputError;
pub use folder::{FrameCounts, OutputFolder};
pub use histogram::Histogram;
pub use html::{rewrite_html, write_html};
pub use loop_table::LoopTable;
pub use publish::{HealthPublisher, MessagePublisher, OdometryPublisher};
pub use renders::{Picture, RenderedKeyframe, Renders, write_render};
pub use report::Report;
pub use stage_times::{N_STAGES, STAGES, Stage, StageTimes};
pub use trajectory::TrajectorySummary;
pub use view_table::{VIEWS_CSV, ViewTable};
