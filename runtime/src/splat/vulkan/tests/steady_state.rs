//! After it is open, an executor takes nothing from Rust's heap and gives the validation layer nothing to say.

use super::copies::{capacities, executor};
use crate::seal;
use crate::splat::device::{EXCHANGE_BYTES, Executor};
use crate::splat::layout::{Counters, IndirectGroups};
use crate::splat::program::{Buffer, Part, WorkSize};
use crate::splat::vulkan::VALIDATION_VARIABLE;
use crate::splat::vulkan::testing;
use ash::vk;
use zerocopy::IntoBytes;

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

/// Software Vulkan (Mesa 22.3) does not give back the memory of some dispatches: of kernels with an early return and much
/// local memory. This finds the kernel.
#[test]
fn no_kernel_makes_the_driver_grow() {
    const N_CALLS: u64 = 100;
    const ALLOWED_BYTES: u64 = 512 << 10;
    let Some(mut executor) = executor() else { return };
    let resident_bytes = || crate::telemetry::process_memory(None).expect("a /proc").rss_bytes;
    let work = WorkSize { slots: 1000, width_px: capacities().image_width_px, height_px: capacities().image_height_px };
    for &part in Part::ALL {
        for (idx, stage) in part.stages().iter().enumerate() {
            let mut grown = u64::MAX;
            // Other tests run beside this one and take memory too, but not each time.
            for _ in 0..5 {
                let before = resident_bytes();
                // There is something to do for kernels that have an invocation per candidate.
                let groups = IndirectGroups { candidates_x: 4, candidates_y: 1, candidates_z: 1, spare: 0 };
                let counters = Counters { candidates: 1000, ..Counters::default() };
                executor.upload(Buffer::Dispatch, 0, groups.as_bytes()).expect("an upload");
                executor.upload(Buffer::Counters, 0, counters.as_bytes()).expect("an upload");
                for _ in 0..N_CALLS {
                    executor.run_stage(part, idx, &work).expect("a kernel");
                    executor.download(Buffer::Counters, 0, &mut [0; 4]).expect("an answer");
                }
                grown = grown.min(resident_bytes().saturating_sub(before));
            }
            let kernel = stage.kernel.spec().name;
            assert!(grown < ALLOWED_BYTES, "{kernel}: {} B per dispatch are not given back", grown / N_CALLS);
        }
    }
}
