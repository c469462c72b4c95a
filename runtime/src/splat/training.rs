//! What one optimizer step takes and tells.

use super::{RenderStats, View};

/// Picture to imitate, of the view's size, row by row.
#[derive(Clone, Copy, Debug)]
pub enum TargetImage<'a> {
    /// Interleaved RGB, three bytes per pixel.
    Rgb8(&'a [u8]),
    /// One byte per pixel, compared with all three channels.
    Gray8(&'a [u8]),
    /// Color in [0, 1].
    RgbF32(&'a [[f32; 3]]),
}

impl TargetImage<'_> {
    /// Pixels that the picture holds.
    pub fn n_pixels(&self) -> usize {
        match self {
            Self::Rgb8(bytes) => bytes.len() / 3,
            Self::Gray8(bytes) => bytes.len(),
            Self::RgbF32(pixels) => pixels.len(),
        }
    }
}

/// Depth to imitate, of the view's size, row by row.
#[derive(Clone, Copy, Debug)]
pub struct DepthTarget<'a> {
    /// Depth along the optical axis, m; anything where the confidence is 0.
    pub depth_m: &'a [f32],
    /// Weight of each pixel in [0, 1]; the loss is the weighted mean.
    pub confidence: &'a [f32],
}

/// One view with its picture.
#[derive(Clone, Copy, Debug)]
pub struct TrainingView<'a> {
    /// Where the camera was.
    pub view: View,
    /// What it saw.
    pub target: TargetImage<'a>,
    /// What is known of the depth.
    pub depth: Option<DepthTarget<'a>>,
    /// Slot of the view's exposure, `None` to compare as is.
    pub exposure_slot: Option<u32>,
}

/// Affine brightness of one view: what is compared is `gain * rendered + bias`, per channel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exposure {
    /// Factor per channel; 1 is none.
    pub gain: [f32; 3],
    /// Offset per channel, in units of full scale; 0 is none.
    pub bias: [f32; 3],
}

impl Exposure {
    /// No correction.
    pub const IDENTITY: Self = Self { gain: [1.0; 3], bias: [0.0; 3] };
}

/// A learning rate that decays exponentially over the schedule.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRate {
    /// Rate at progress 0.
    pub start: f32,
    /// Rate at progress 1; both must be positive to decay, otherwise `start` is kept.
    pub end: f32,
}

impl LearningRate {
    /// The same rate throughout.
    pub const fn constant(rate: f32) -> Self {
        Self { start: rate, end: rate }
    }

    /// Rate at `progress` in [0, 1] (clamped): `start^(1-p) * end^p`.
    pub fn at(&self, progress: f32) -> f32 {
        if self.start <= 0.0 || self.end <= 0.0 {
            return self.start;
        }
        let p = progress.clamp(0.0, 1.0);
        (self.start.ln() * (1.0 - p) + self.end.ln() * p).exp()
    }
}

/// Adam step sizes of features and of the decoder that learns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DecoderRates {
    /// Features of the anchors in view.
    pub feature: LearningRate,
    /// `W1` and `b1`.
    pub hidden: LearningRate,
    /// Rows of `W2` and `b2` whose output is an offset.
    pub offset: LearningRate,
    /// The same for logarithms of scales.
    pub log_scale: LearningRate,
    /// The same for quaternion components.
    pub rotation: LearningRate,
    /// The same for opacity logits.
    pub opacity: LearningRate,
    /// The same for color logits.
    pub color: LearningRate,
}

impl DecoderRates {
    /// Nothing of the decoder learns.
    pub const FROZEN: Self = Self {
        feature: LearningRate::constant(0.0),
        hidden: LearningRate::constant(0.0),
        offset: LearningRate::constant(0.0),
        log_scale: LearningRate::constant(0.0),
        rotation: LearningRate::constant(0.0),
        opacity: LearningRate::constant(0.0),
        color: LearningRate::constant(0.0),
    };

    /// The peers' values (method.md 10); the hidden layer, which theirs do not share, at the rate of the covariance.
    pub const METHOD: Self = Self {
        feature: LearningRate::constant(0.0075),
        hidden: LearningRate::constant(0.004),
        offset: LearningRate::constant(0.004),
        log_scale: LearningRate::constant(0.004),
        rotation: LearningRate::constant(0.004),
        opacity: LearningRate { start: 0.002, end: 2e-5 },
        color: LearningRate { start: 0.008, end: 5e-5 },
    };
}

/// Adam step sizes per parameter group.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LearningRates {
    /// Offsets, in units of the anchor's extent.
    pub offset: LearningRate,
    /// Logarithms of scales.
    pub log_scale: LearningRate,
    /// Quaternion components.
    pub rotation: LearningRate,
    /// Opacity logits.
    pub opacity: LearningRate,
    /// Color logits.
    pub color: LearningRate,
    /// Background texels, in units of full scale.
    pub background: LearningRate,
    /// Exposure gain and bias.
    pub exposure: LearningRate,
    /// Features and decoder; without effect where the backend has none.
    pub decoder: DecoderRates,
}

impl LearningRates {
    /// Whether nothing of a Gaussian or the background learns at `progress`; exposure and decoder have their own rules.
    pub fn map_is_frozen(&self, progress: f32) -> bool {
        let rates = [self.offset, self.log_scale, self.rotation, self.opacity, self.color, self.background];
        rates.iter().all(|rate| rate.at(progress) <= 0.0)
    }

    /// Rates for directly trained Gaussians. Offsets and scales are the peers' values for anchors (method.md 10);
    /// logits and quaternions follow Kerbl et al. 2023 with colors an order faster, because a driving camera
    /// sees a surface in tens of steps and not in tens of thousands.
    pub const DIRECT: Self = Self {
        offset: LearningRate { start: 0.01, end: 1e-4 },
        log_scale: LearningRate::constant(0.007),
        rotation: LearningRate::constant(0.004),
        opacity: LearningRate::constant(0.05),
        color: LearningRate { start: 0.03, end: 0.01 },
        background: LearningRate { start: 0.01, end: 0.002 },
        exposure: LearningRate::constant(0.001),
        decoder: DecoderRates::FROZEN,
    };

    /// Nothing learns: no number changes, and none of what the optimizer remembers.
    pub const FROZEN: Self = Self {
        offset: LearningRate::constant(0.0),
        log_scale: LearningRate::constant(0.0),
        rotation: LearningRate::constant(0.0),
        opacity: LearningRate::constant(0.0),
        color: LearningRate::constant(0.0),
        background: LearningRate::constant(0.0),
        exposure: LearningRate::constant(0.0),
        decoder: DecoderRates::FROZEN,
    };
}

/// Factors of the loss terms (method.md 10).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossWeights {
    /// Mean absolute color difference.
    pub l1: f32,
    /// `1 - SSIM`, windows of 11x11 px with sigma 1.5 px.
    pub ssim: f32,
    /// Confidence-weighted mean absolute depth difference, per m.
    pub depth: f32,
    /// Mean over the visible Gaussians of `|s - mean(s)|_1`, s in units of the anchor's extent.
    pub isotropy: f32,
    /// Mean square of `gain - 1` and `bias`.
    pub exposure: f32,
}

impl LossWeights {
    /// The method's weights.
    pub const METHOD: Self = Self { l1: 0.8, ssim: 0.2, depth: 0.01, isotropy: 10.0, exposure: 0.1 };

    /// The terms of [`METHOD`](Self::METHOD) that look at the picture.
    pub const PHOTOMETRIC: Self = Self { depth: 0.0, isotropy: 0.0, exposure: 0.0, ..Self::METHOD };
}

/// How one step is taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepSettings {
    /// Adam step sizes; a group with rate 0 is frozen.
    pub rates: LearningRates,
    /// Where in the decay this step is: 0 at the beginning of the chunk, 1 at its end.
    pub progress: f32,
    /// Factors of the loss terms.
    pub weights: LossWeights,
    /// Chunk row whose decoder learns; those of all others are frozen. Features learn whatever their row.
    pub decoder_row: Option<u16>,
    /// Chunk rows whose anchors are drawn and not trained: no gradient reaches them. Those of them that were trained before
    /// coast to a halt.
    pub finished: ChunkRows,
    /// Also find [`StepReport::pose_gradient`], which costs a little.
    pub pose_gradient: bool,
}

/// A set of chunk rows; rows from [`ChunkRows::BITS`] on are never in it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ChunkRows(u32);

impl ChunkRows {
    /// No row.
    pub const NONE: Self = Self(0);
    /// Rows that can be in a set.
    pub const BITS: u16 = u32::BITS as u16;

    /// The set with a row more.
    pub fn with(self, row: u16) -> Self {
        Self(self.0 | 1u32.checked_shl(row.into()).unwrap_or(0))
    }

    /// Whether a row is in the set.
    #[inline(always)]
    pub fn contains(self, row: u16) -> bool {
        row < Self::BITS && self.0 >> row & 1 == 1
    }

    /// A bit for each row, row 0 the lowest.
    pub fn bits(self) -> u32 {
        self.0
    }
}

impl StepSettings {
    /// The method's weights with rates for directly trained Gaussians.
    pub const fn direct(progress: f32) -> Self {
        Self {
            rates: LearningRates::DIRECT,
            progress,
            weights: LossWeights::METHOD,
            decoder_row: None,
            finished: ChunkRows::NONE,
            pose_gradient: false,
        }
    }

    /// The same, but nothing is learnt: with `pose_gradient`, a step that only looks for where the camera is.
    pub const fn frozen(self) -> Self {
        Self { rates: LearningRates::FROZEN, ..self }
    }
}

/// Loss terms before their weights, and the weighted sum.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LossTerms {
    /// Mean absolute color difference.
    pub l1: f32,
    /// Mean SSIM (1 is equal).
    pub ssim: f32,
    /// Mean squared color difference after exposure: `psnr = -10 log10(mse)`.
    pub mse: f32,
    /// Weighted mean absolute depth difference, m.
    pub depth: f32,
    /// Mean anisotropy.
    pub isotropy: f32,
    /// Mean square deviation of the exposure from identity.
    pub exposure: f32,
    /// The weighted sum that was minimised.
    pub total: f32,
}

/// Gradient with respect to the tangent `[omega, upsilon]` (rad, m) at 0 of the left increment
/// `exp(tangent) * camera_from_map` (see [`kilogs_core::conventions`]).
///
/// It goes through all that a pose changes continuously: means, covariances and the linearisation of the projection,
/// depths, the fading between levels, the sky's directions, and what a learned decoder makes of the place it is seen from.
/// What moves in steps is left out, as in every gradient of a splat: where it ends, and which are in front.
pub type PoseGradient = [f64; 6];

/// What one step did.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StepReport {
    /// Loss before the step.
    pub loss: LossTerms,
    /// Size of the work; `refused` when the view or a slice did not fit, and nothing was changed.
    pub stats: RenderStats,
    /// Gradient of [`LossTerms::total`] with respect to the view's pose before the step, when
    /// [`StepSettings::pose_gradient`] asks for it.
    pub pose_gradient: Option<PoseGradient>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_decay_exponentially_between_their_ends() {
        let rate = LearningRate { start: 0.01, end: 1e-4 };
        for (progress, expected) in [(-1.0, 1e-2), (0.0, 1e-2), (0.5, 1e-3), (1.0, 1e-4), (2.0, 1e-4)] {
            let got = rate.at(progress);
            assert!((got / expected - 1.0).abs() < 1e-4, "progress {progress}: {got}, expected {expected}");
        }
    }

    #[test]
    fn a_frozen_group_stays_frozen() {
        assert_eq!(LearningRate::constant(0.0).at(0.3), 0.0);
        assert_eq!(LearningRate { start: 0.5, end: 0.0 }.at(1.0), 0.5);
    }
}
