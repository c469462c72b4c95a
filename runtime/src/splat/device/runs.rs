//! Runs of a view: what is uploaded before them, which parts they have, and what they counted.

use super::backend::DeviceBackend;
use super::error::DeviceError;
use super::executor::Executor;
use super::view::place;
use crate::splat::layout::{Counters, ViewBlock};
use crate::splat::program::{Buffer, Part, WorkSize};
use crate::splat::{Capacities, Overflow, RenderStats, StageClock, View};
use core::cell::RefCell;
use zerocopy::IntoBytes;

/// An executor, and what went wrong with it first.
pub(super) struct Device<E> {
    pub(super) executor: RefCell<E>,
    pub(super) failure: RefCell<Option<DeviceError>>,
}

impl<E: Executor> Device<E> {
    /// A device that works.
    pub fn new(executor: E) -> Self {
        Self { executor: RefCell::new(executor), failure: RefCell::new(None) }
    }

    /// Does something unless the device has failed; false, and the reason is kept, when it fails now.
    pub fn call(&self, action: impl FnOnce(&mut E) -> Result<(), DeviceError>) -> bool {
        if self.failure.borrow().is_some() {
            return false;
        }
        match action(&mut self.executor.borrow_mut()) {
            Ok(()) => true,
            Err(error) => {
                *self.failure.borrow_mut() = Some(error);
                false
            }
        }
    }
}

/// Parts of one run.
pub(super) type Parts = heapless::Vec<Part, { Part::ALL.len() }>;

/// Bytes of [`Buffer::Bounds`].
const BOUNDS_BYTES: usize = 16;

impl<E: Executor> DeviceBackend<E> {
    pub(super) fn work(&self, view: &View) -> WorkSize {
        WorkSize { slots: self.slots.end() as u32, width_px: view.camera.width, height_px: view.camera.height }
    }

    /// The parts that draw, then others; without those of learned decoders where nothing is learned.
    pub(super) fn drawing_then(&self, others: &[Part]) -> Parts {
        let drawing = [Part::Project, Part::Decode, Part::MakeSplats, Part::Sort, Part::Blend];
        let is_learned = self.capacities.learned_decoder;
        let is_run = |part: &Part| is_learned || !matches!(part, Part::Decode | Part::StepDecoder);
        drawing.iter().chain(others).copied().filter(is_run).collect()
    }

    /// Uploads what the kernels need of a view, and runs the parts.
    pub(super) fn run(&mut self, view: &View, block: &ViewBlock, parts: &[Part]) -> bool {
        place(view, &self.placements, &mut self.keyframes);
        let keyframes = self.keyframes.as_bytes();
        if let Some(clock) = &mut self.clock {
            clock.restart();
        }
        let uploaded = self.device.call(|e| {
            e.upload(Buffer::View, 0, block.as_bytes())?;
            e.upload(Buffer::Keyframes, 0, keyframes)?;
            e.clear(Buffer::Counters, 0, size_of::<Counters>())?;
            e.clear(Buffer::Bounds, 0, BOUNDS_BYTES)
        });
        uploaded && self.run_more(view, parts)
    }

    /// Runs further parts of the view that was drawn last.
    pub(super) fn run_more(&mut self, view: &View, parts: &[Part]) -> bool {
        let work = self.work(view);
        match &mut self.clock {
            None => self.device.call(|e| e.run(parts, &work)),
            Some(clock) => parts.iter().all(|&part| self.device.call(|e| run_timed(e, part, &work, clock))),
        }
    }

    /// Waits for the last run and reads its counters.
    pub(super) fn stats(&self) -> Option<RenderStats> {
        let mut counters = Counters::default();
        let read = self.device.call(|e| e.download(Buffer::Counters, 0, counters.as_mut_bytes()));
        read.then(|| stats_of(&counters, &self.capacities))
    }
}

fn run_timed<E: Executor>(
    executor: &mut E,
    part: Part,
    work: &WorkSize,
    clock: &mut StageClock,
) -> Result<(), DeviceError> {
    let mut word = [0; 4];
    executor.download(Buffer::Counters, 0, &mut word)?;
    clock.finish("upload");
    for (i, stage) in part.stages().iter().enumerate() {
        executor.run_stage(part, i, work)?;
        executor.download(Buffer::Counters, 0, &mut word)?;
        clock.finish(stage.kernel.spec().name);
    }
    Ok(())
}

pub(super) fn refused() -> RenderStats {
    RenderStats { refused: true, ..RenderStats::default() }
}

fn stats_of(counters: &Counters, capacities: &Capacities) -> RenderStats {
    let over = |needed: u32, capacity: usize| needed.saturating_sub(capacity as u32);
    RenderStats {
        visible: counters.visible,
        row_entries: counters.entries_needed.min(capacities.row_entries as u32),
        pairs: counters.pairs,
        overflow: Overflow {
            visible_gaussians: over(counters.candidates_needed, capacities.visible_gaussians),
            row_entries: over(counters.entries_needed, capacities.row_entries),
            pairs: over(counters.pairs_needed, capacities.pairs),
        },
        refused: false,
    }
}
