//! `kilogs refine`: a stored map is trained on its own pictures, in place and in the same memory.
//!
//! ```text
//! stretches of the route, twice   schedule.rs    the second time their ends are where their middles were
//!   pages that they see           stretch.rs     loaded whole near by, coarse levels only far away
//!   who else sees these           guests.rs      trained too, or the map would forget them
//!   training                      trainer.rs     every picture of the stretch as often as the others
//!   lifecycle, once               renew.rs       what is faint, wrong or too much ends; what shows errors is split
//!   pages, chunks                 stretch.rs     replaced file by file: whatever happens, the map opens
//! figures of the run              run_folder.rs  follow the map, where a run left it
//! ```
//!
//! Held-out views judge and are in no loss.

mod guests;
mod images;
mod lifecycle;
mod renew;
mod run;
mod run_folder;
mod schedule;
mod settings;
mod stretch;
mod summary;
mod trainer;

pub use renew::RenewCounts;
pub use run::{RefineRequest, run};
pub use settings::{LifecycleSettings, PruneScore};
pub use summary::RefineSummary;

#[cfg(test)]
mod tests;
