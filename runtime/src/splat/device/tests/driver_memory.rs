//! What a driver takes beside the arena: it stays within its row of the budget, and does not grow.

use super::devices::{Device, on_every_device, on_vulkan, on_wgpu};
use super::training::Problem;
use crate::budget::{Budget, Row};
use crate::splat::program::Part;
use crate::splat::vulkan::VALIDATION_VARIABLE;
use crate::telemetry::process_memory;
use std::process::Command;

/// Set to the API in the process that measures: it has nothing else in its memory.
const ALONE_VARIABLE: &str = "KILOGS_TEST_ALONE";
const N_STEPS: usize = 200;

/// Says what many steps took beyond what was there before the device was opened and beyond its arena.
fn measure(api: &str) {
    let problem = Problem::new(96, 64, 60);
    let before = process_memory(None).expect("a /proc").rss_bytes;
    let steps = |who: &str, backend: &mut dyn Device| {
        problem.fill(backend);
        let mut step = || assert!(!backend.train_step(&problem.training(), &problem.settings).stats.refused, "{who}");
        (0..N_STEPS / 4).for_each(|_| step());
        let early = process_memory(None).expect("a /proc").rss_bytes;
        (N_STEPS / 4..N_STEPS).for_each(|_| step());
        let late = process_memory(None).expect("a /proc");
        let taken = late.peak_bytes.saturating_sub(before + backend.arena_bytes());
        println!("{taken} B taken, {} B of them since step {}", late.rss_bytes.saturating_sub(early), N_STEPS / 4);
    };
    if api == "wgpu" { on_wgpu(problem.capacities, steps) } else { on_vulkan(problem.capacities, steps) }
}

#[test]
fn the_row_of_the_driver_holds_what_a_driver_takes() {
    if let Ok(api) = std::env::var(ALONE_VARIABLE) {
        return measure(&api);
    }
    let this = "splat::device::tests::driver_memory::the_row_of_the_driver_holds_what_a_driver_takes";
    let row = Budget::builtin().expect("valid").capacity(Row::ProcessComputeDriver) as u64;
    for api in ["vulkan", "wgpu"] {
        let mut alone = Command::new(std::env::current_exe().expect("this program"));
        alone.args(["--exact", this, "--nocapture"]).env(ALONE_VARIABLE, api);
        // The layer takes memory of its own, which no budget has to hold.
        let ended = alone.env_remove(VALIDATION_VARIABLE).output().expect("it runs");
        let said = String::from_utf8_lossy(&ended.stdout);
        assert!(ended.status.success(), "{said}{}", String::from_utf8_lossy(&ended.stderr));
        // Without a device it says so instead.
        let figures = said.lines().find(|line| line.contains(" B taken")).unwrap_or("0 B taken, 0 B");
        println!("{api}: {figures}");
        let mut bytes = figures.split(' ').filter_map(|word| word.parse::<u64>().ok());
        let [taken, grown] = [bytes.next(), bytes.next()].map(|figure| figure.expect("a figure"));
        assert!(taken <= row, "{api}: {figures}, and [process.compute_driver] has {row} B");
        assert!(grown <= 4 << 20, "{api} goes on growing: {figures}");
    }
}

/// Software Vulkan (Mesa 22.3) does not give back the memory of some dispatches: of kernels with an early return and much
/// local memory, and of shaders that it compiles anew for the numbers of a view. This finds the kernels.
#[test]
fn no_kernel_makes_the_driver_grow() {
    const N_CALLS: u64 = 100;
    const ALLOWED_BYTES: u64 = 512 << 10;
    let resident_bytes = || process_memory(None).expect("a /proc").rss_bytes;
    let problem = Problem::new(96, 64, 60);
    on_every_device(problem.capacities, |who, backend| {
        problem.fill(backend);
        // The numbers of a view, and something to do for every kernel.
        assert!(!backend.train_step(&problem.training(), &problem.settings).stats.refused, "{who}");
        let mut growing = Vec::new();
        let parts = Part::ALL.iter().filter(|part| !matches!(part, Part::Decode | Part::StepDecoder));
        for (part, idx) in parts.flat_map(|&part| (0..part.stages().len()).map(move |idx| (part, idx))) {
            let mut grown = u64::MAX;
            // Other tests run beside this one and take memory too, but not each time.
            for _ in 0..5 {
                let before = resident_bytes();
                for _ in 0..N_CALLS {
                    backend.run_stage(&problem.training().view, part, idx);
                }
                grown = grown.min(resident_bytes().saturating_sub(before));
                if grown < ALLOWED_BYTES {
                    break;
                }
            }
            if grown >= ALLOWED_BYTES {
                growing.push((part.stages()[idx].kernel.spec().name, grown / N_CALLS));
            }
        }
        assert!(growing.is_empty(), "bytes per dispatch that are not given back on {who}: {growing:?}");
    });
}
