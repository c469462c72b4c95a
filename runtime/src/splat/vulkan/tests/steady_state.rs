//! After it is open, an executor takes nothing from Rust's heap.

use super::copies::{capacities, executor};
use crate::seal;
use crate::splat::device::{EXCHANGE_BYTES, Executor};
use crate::splat::program::{Buffer, Part, WorkSize};
use crate::splat::vulkan::validation_messages;

#[test]
fn a_step_allocates_nothing() {
    let Some(mut executor) = executor() else { return };
    let numbers = vec![1; EXCHANGE_BYTES + 400];
    let mut read = vec![0; EXCHANGE_BYTES + 400];
    let work = WorkSize { slots: 1000, width_px: capacities().image_width_px, height_px: capacities().image_height_px };
    // The layer allocates on this thread while it watches.
    let is_watched = validation_messages() > 0 || std::env::var_os("KILOGS_VULKAN_VALIDATION").is_some();
    let mut step = || {
        executor.upload(Buffer::Params, 0, &numbers)?;
        executor.clear(Buffer::Params, 0, numbers.len())?;
        executor.clear(Buffer::Counters, 0, 4)?;
        executor.run(Part::ALL, &work)?;
        executor.run(Part::ALL, &work)?;
        executor.download(Buffer::Params, 0, &mut read)
    };
    step().expect("the first step");
    let sealed = seal::enter();
    let steps: Result<(), _> = (0..3).try_for_each(|_| step());
    let violations = sealed.violations();
    drop(sealed);
    steps.expect("three more");
    assert!(is_watched || violations == (0, 0), "{violations:?}");
}
