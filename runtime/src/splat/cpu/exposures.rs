//! Affine brightness of the training views.

use super::adam::{BiasCorrection, adam};
use super::loss::ExposureGradient;
use crate::splat::Exposure;

/// Exposure slots with what the optimizer remembers.
pub struct Exposures {
    slots: Vec<Slot>,
}

#[derive(Clone, Copy)]
struct Slot {
    exposure: Exposure,
    first: [f64; 6],
    second: [f64; 6],
    steps: u32,
}

/// Bytes of one exposure slot.
pub const EXPOSURE_BYTES: usize = size_of::<Slot>();

impl Slot {
    fn new(exposure: Exposure) -> Self {
        Self { exposure, first: [0.0; 6], second: [0.0; 6], steps: 0 }
    }
}

impl Exposures {
    /// Slots without correction.
    pub fn new(n: usize) -> Self {
        Self { slots: vec![Slot::new(Exposure::IDENTITY); n] }
    }

    /// Exposure of a slot.
    pub fn get(&self, slot: u32) -> Option<Exposure> {
        self.slots.get(slot as usize).map(|s| s.exposure)
    }

    /// Replaces a slot and forgets its moments.
    pub fn set(&mut self, slot: u32, exposure: Exposure) -> bool {
        let finite = exposure.gain.iter().chain(&exposure.bias).all(|v| v.is_finite());
        match self.slots.get_mut(slot as usize).filter(|_| finite) {
            Some(found) => {
                *found = Slot::new(exposure);
                true
            }
            None => false,
        }
    }

    /// One Adam step, pulled towards identity; returns the mean square deviation before it.
    pub fn step(&mut self, slot: u32, gradient: &ExposureGradient, weight: f32, rate: f32) -> f32 {
        let Some(slot) = self.slots.get_mut(slot as usize) else { return 0.0 };
        let Exposure { gain, bias } = &mut slot.exposure;
        let deviations = [gain[0] - 1.0, gain[1] - 1.0, gain[2] - 1.0, bias[0], bias[1], bias[2]];
        let n = deviations.len() as f32;
        let mean_square = deviations.iter().map(|d| d * d).sum::<f32>() / n;
        if rate > 0.0 {
            slot.steps = slot.steps.saturating_add(1);
            let correction = BiasCorrection::at(f64::from(slot.steps));
            for (i, value) in gain.iter_mut().chain(bias).enumerate() {
                let by_loss = if i < 3 { gradient.gain[i] } else { gradient.bias[i - 3] };
                let by_prior = f64::from(2.0 * weight * deviations[i] / n);
                let [new, first, second] = adam(
                    f64::from(*value),
                    slot.first[i],
                    slot.second[i],
                    by_loss + by_prior,
                    f64::from(rate),
                    &correction,
                );
                (*value, slot.first[i], slot.second[i]) = (new as f32, first, second);
            }
        }
        mean_square
    }
}
