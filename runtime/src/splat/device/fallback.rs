//! A device backend that is replaced by the CPU backend when its device is gone.
//!
//! The mapper never notices: the call during which the device went is repeated on the CPU with the map as the host last
//! saw it ([`HostCopy`]). Tracking runs on its own thread and has nothing to do with it.

use super::backend::DeviceBackend;
use super::executor::Executor;
use super::host_copy::HostCopy;
use crate::seal;
use crate::splat::{
    AnchorFeature, AnchorHeader, AnchorScore, Capacities, Exposure, GaussianParams, KeyframePlacement, RenderStats,
    RenderTarget, ScoreReport, SplatBackend, StageTimes, StepReport, StepSettings, TrainingView, View,
};
use std::cell::RefCell;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// A backend that can stop working.
pub trait CanFail: SplatBackend {
    /// Why it stopped, if it did. It refuses every view and every read from then on.
    fn failure(&self) -> Option<String>;
}

impl<E: Executor> CanFail for DeviceBackend<E> {
    fn failure(&self) -> Option<String> {
        Self::failure(self)
    }
}

/// Makes the backend that goes on when a device is gone.
pub type MakeSubstitute = Box<dyn Fn() -> Result<Box<dyn SplatBackend>, String> + Send>;

/// A device backend with a substitute behind it.
pub struct FallbackBackend<B> {
    capacities: Capacities,
    device: Option<B>,
    copy: RefCell<HostCopy>,
    make_substitute: MakeSubstitute,
    /// Made when it is needed: until then the device has the memory.
    substitute: Option<Box<dyn SplatBackend>>,
    has_fallen_back: Arc<AtomicBool>,
}

impl<B: CanFail> FallbackBackend<B> {
    /// Puts `make_substitute` behind `device`. `has_fallen_back` is set when the substitute takes over.
    pub fn new(device: B, make_substitute: MakeSubstitute, has_fallen_back: Arc<AtomicBool>) -> Self {
        let capacities = *device.capacities();
        let copy = RefCell::new(HostCopy::new(&capacities));
        Self { capacities, device: Some(device), copy, make_substitute, substitute: None, has_fallen_back }
    }

    /// The device is still there, as far as is known.
    pub fn has_device(&self) -> bool {
        self.working().is_some()
    }

    fn working(&self) -> Option<&B> {
        self.device.as_ref().filter(|device| device.failure().is_none())
    }

    /// Does something on whatever computes now, and again on the substitute when the device goes meanwhile.
    fn call<T>(&mut self, mut action: impl FnMut(&mut dyn SplatBackend) -> T) -> Option<T> {
        if let Some(device) = &mut self.device {
            let done = action(device);
            match device.failure() {
                None => return Some(done),
                Some(reason) => self.fall_back(&reason),
            }
        }
        self.substitute.as_mut().map(|substitute| action(substitute.as_mut()))
    }

    /// Gives the device's memory back, makes the substitute and hands it the map.
    fn fall_back(&mut self, reason: &str) {
        // Once in a run, and far from any steady state: the substitute's buffers are taken now.
        let _allocates = seal::lift();
        self.device = None;
        self.has_fallen_back.store(true, Relaxed);
        match (self.make_substitute)() {
            Ok(mut substitute) => {
                let n_anchors = self.copy.borrow().restore_into(substitute.as_mut());
                log::error!(
                    "{reason}. Mapping goes on with the CPU backend; {n_anchors} anchors are as the host last saw them, \
                     what they learnt since is gone. Tracking is not affected"
                );
                self.substitute = Some(substitute);
            }
            Err(problem) => log::error!("{reason}. There is no CPU backend to go on with ({problem}): mapping stops"),
        }
    }
}

fn refused() -> RenderStats {
    RenderStats { refused: true, ..RenderStats::default() }
}

impl<B: CanFail> SplatBackend for FallbackBackend<B> {
    fn capacities(&self) -> &Capacities {
        &self.capacities
    }

    fn write_anchors(&mut self, slots: &[u32], headers: &[AnchorHeader], params: &[GaussianParams]) -> usize {
        // The copy first: whatever happens in the call, the substitute has them.
        self.copy.get_mut().note_anchors(slots, headers, params);
        self.copy.get_mut().clear_features(slots);
        self.call(|backend| backend.write_anchors(slots, headers, params)).unwrap_or(slots.len())
    }

    fn read_anchors(&self, slots: &[u32], headers: &mut [AnchorHeader], params: &mut [GaussianParams]) -> usize {
        if let Some(device) = self.working() {
            let n_missing = device.read_anchors(slots, headers, params);
            if device.failure().is_none() {
                if n_missing == 0 {
                    self.copy.borrow_mut().note_anchors(slots, headers, params);
                }
                return n_missing;
            }
        }
        match &self.substitute {
            Some(substitute) => substitute.read_anchors(slots, headers, params),
            None => self.copy.borrow().read_anchors(slots, headers, params),
        }
    }

    fn write_features(&mut self, slots: &[u32], features: &[AnchorFeature]) -> usize {
        self.copy.get_mut().note_features(slots, features);
        self.call(|backend| backend.write_features(slots, features)).unwrap_or(slots.len())
    }

    fn read_features(&self, slots: &[u32], features: &mut [AnchorFeature]) -> usize {
        if let Some(device) = self.working() {
            let n_missing = device.read_features(slots, features);
            if device.failure().is_none() {
                if n_missing == 0 {
                    self.copy.borrow_mut().note_features(slots, features);
                }
                return n_missing;
            }
        }
        match &self.substitute {
            Some(substitute) => substitute.read_features(slots, features),
            None => self.copy.borrow().read_features(slots, features),
        }
    }

    fn retire_anchors(&mut self, slots: &[u32]) -> usize {
        self.copy.get_mut().retire(slots);
        self.call(|backend| backend.retire_anchors(slots)).unwrap_or(slots.len())
    }

    fn set_keyframes(&mut self, first_row: u32, placements: &[KeyframePlacement]) -> usize {
        self.copy.get_mut().note_keyframes(first_row, placements);
        self.call(|backend| backend.set_keyframes(first_row, placements)).unwrap_or(placements.len())
    }

    fn write_background(&mut self, chunk_row: u16, texels: &[[f32; 3]]) -> bool {
        self.copy.get_mut().note_background(chunk_row, texels);
        self.call(|backend| backend.write_background(chunk_row, texels)).unwrap_or(false)
    }

    fn read_background(&self, chunk_row: u16, texels: &mut [[f32; 3]]) -> bool {
        if let Some(device) = self.working() {
            let read = device.read_background(chunk_row, texels);
            if device.failure().is_none() {
                if read {
                    self.copy.borrow_mut().note_background(chunk_row, texels);
                }
                return read;
            }
        }
        match &self.substitute {
            Some(substitute) => substitute.read_background(chunk_row, texels),
            None => self.copy.borrow().read_background(chunk_row, texels),
        }
    }

    fn write_decoder(&mut self, chunk_row: u16, weights: &[f32]) -> bool {
        self.copy.get_mut().note_decoder(chunk_row, weights);
        self.call(|backend| backend.write_decoder(chunk_row, weights)).unwrap_or(false)
    }

    fn read_decoder(&self, chunk_row: u16, weights: &mut [f32]) -> bool {
        if let Some(device) = self.working() {
            let read = device.read_decoder(chunk_row, weights);
            if device.failure().is_none() {
                if read {
                    self.copy.borrow_mut().note_decoder(chunk_row, weights);
                }
                return read;
            }
        }
        match &self.substitute {
            Some(substitute) => substitute.read_decoder(chunk_row, weights),
            None => self.copy.borrow().read_decoder(chunk_row, weights),
        }
    }

    fn write_exposure(&mut self, slot: u32, exposure: Exposure) -> bool {
        self.copy.get_mut().note_exposure(slot, exposure);
        self.call(|backend| backend.write_exposure(slot, exposure)).unwrap_or(false)
    }

    fn read_exposure(&self, slot: u32) -> Option<Exposure> {
        match (self.working(), &self.substitute) {
            (Some(device), _) => device.read_exposure(slot),
            (None, Some(substitute)) => substitute.read_exposure(slot),
            (None, None) => self.copy.borrow().read_exposure(slot),
        }
    }

    fn render(&mut self, view: &View, target: RenderTarget<'_>) -> RenderStats {
        let RenderTarget { rgb, depth_m, transmittance } = target;
        self.call(|backend| backend.render(view, RenderTarget { rgb, depth_m, transmittance })).unwrap_or_else(refused)
    }

    fn train_step(&mut self, view: &TrainingView<'_>, settings: &StepSettings) -> StepReport {
        let stopped = || StepReport { stats: refused(), ..StepReport::default() };
        self.call(|backend| backend.train_step(view, settings)).unwrap_or_else(stopped)
    }

    fn score_view(&mut self, view: &TrainingView<'_>, error_threshold: f32, scores: &mut [AnchorScore]) -> ScoreReport {
        self.call(|backend| backend.score_view(view, error_threshold, scores)).unwrap_or_else(ScoreReport::refused)
    }

    fn stage_times(&self) -> StageTimes {
        match (self.working(), &self.substitute) {
            (Some(device), _) => device.stage_times(),
            (None, Some(substitute)) => substitute.stage_times(),
            (None, None) => StageTimes::default(),
        }
    }
}
