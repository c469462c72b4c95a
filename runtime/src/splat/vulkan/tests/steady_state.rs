//! After it is open, an executor takes nothing from Rust's heap and gives the validation layer nothing to say.

use super::copies::{capacities, executor};
use crate::seal;
use crate::splat::device::{EXCHANGE_BYTES, Executor};
use crate::splat::program::{Buffer, Part, WorkSize};
use crate::splat::vulkan::VALIDATION_VARIABLE;
use crate::splat::vulkan::testing;
use ash::vk;

#[test]
fn a_step_allocates_nothing() {
    let Some(mut executor) = executor() else { return };
    let numbers = vec![1; EXCHANGE_BYTES + 400];
    let mut read = vec![0; EXCHANGE_BYTES + 400];
    let work = WorkSize { slots: 1000, width_px: capacities().image_width_px, height_px: capacities().image_height_px };
    // The layer allocates on this thread while it watches.
    let is_watched = std::env::var_os(VALIDATION_VARIABLE).is_some();
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

#[test]
fn the_validation_layer_is_heard() {
    let Some(device) = testing::device() else { return };
    if std::env::var_os(VALIDATION_VARIABLE).is_none() {
        println!("skipped: {VALIDATION_VARIABLE} is not set");
        return;
    }
    let nothing = vk::BufferCreateInfo::default();
    let n_messages = testing::provoke(|| {
        // SAFETY: a buffer of no bytes and no use is wrong, which is the point; drivers refuse it or make one.
        unsafe {
            if let Ok(buffer) = device.raw().create_buffer(&nothing, None) {
                device.raw().destroy_buffer(buffer, None);
            }
        }
    });
    assert!(n_messages > 0, "the layer is not there: install vulkan-validationlayers");
}
