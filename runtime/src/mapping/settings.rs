//! What decides how a map is built.

use crate::splat::{ChunkRows, DecoderRates, LearningRate, LearningRates, LossWeights, StepSettings};
use kilogs_core::map::depth::motion_stereo::StereoSettings;
use kilogs_core::map::depth::sparse::SparseSettings;
use kilogs_core::map::insertion::InsertionSettings;
use kilogs_core::map::spawn::SpawnSettings;

/// One optimizer step: [`LearningRates::DIRECT`] two to five times as fast, because a surface is looked at in some
/// tens of steps before the vehicle has passed it, and no pull towards round Gaussians, because a road seen at a
/// grazing angle is flat. On 20 keyframes of a street, ten steps each: 20.9 dB with the method's rates and its weight
/// of 10, 21.5 dB without that weight, 23.2 dB with two to three times the rates (and bare and wrong pixels sampled
/// more), 23.4 dB with these.
const STEP: StepSettings = StepSettings {
    rates: LearningRates {
        offset: LearningRate { start: 0.03, end: 3e-4 },
        log_scale: LearningRate::constant(0.035),
        opacity: LearningRate::constant(0.1),
        color: LearningRate { start: 0.12, end: 0.04 },
        exposure: LearningRate::constant(0.003),
        decoder: DECODER,
        ..LearningRates::DIRECT
    },
    // A drive stays at the first rates, only a fit comes to the last: a vehicle meets new surfaces until the chunk closes.
    // With the method's decay over the chunk's 100 keyframes, the first 120 frames (64 keyframes, ten steps each) of the
    // small color set of KITTI 00 score 18.76 dB held out instead of 18.87 dB, and 20.34 dB instead of 20.36 dB trained.
    progress: 0.0,
    weights: LossWeights { depth: 0.0, isotropy: 0.0, ..LossWeights::METHOD },
    decoder_row: None,
    finished: ChunkRows::NONE,
    pose_gradient: false,
};

/// Step sizes of a learned decoder: colors only, and slowly, because the stored numbers learn fast beside it. Held out at
/// 20 steps per keyframe: 18.31 dB instead of 18.22 dB on the first 150 frames of the small color set of KITTI 00 (mean
/// of three seeds), 22.22 dB instead of 22.11 dB on the first 80 frames of KITTI 04 (of two). With
/// [`DecoderRates::METHOD`], that is with all heads, 18.08 instead of 18.21 dB and 22.23 instead of 22.07 dB (of one).
const DECODER: DecoderRates = DecoderRates {
    feature: LearningRate::constant(0.002),
    hidden: LearningRate::constant(0.001),
    color: LearningRate::constant(0.002),
    ..DecoderRates::FROZEN
};

/// Everything of the mapper that changes results and is not a capacity.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapperSettings {
    /// Seed of the run.
    pub seed: u64,
    /// Size of the training images relative to the camera's, (0, 1].
    pub resolution: f64,
    /// Training images are at least this wide, or as wide as the camera's, px: a small camera has no detail to spare.
    pub min_width_px: u32,
    /// Gaussians that a drive adds per metre of route, above 0.
    pub gaussians_per_m: f64,
    /// Metres of route that a view is worth which shows nothing seen before, at least 0.
    pub first_view_m: f64,
    /// Where Gaussians are inserted.
    pub insertion: InsertionSettings,
    /// First values of a Gaussian.
    pub spawn: SpawnSettings,
    /// Depth from earlier keyframes.
    pub stereo: StereoSettings,
    /// Depth from triangulated points, where there is no earlier keyframe.
    pub sparse: SparseSettings,
    /// Depth that is less sure than this is not inserted, [0, 1].
    pub min_confidence: f32,
    /// Keyframes that are trained together, at least 1. Peers: 4 to 8.
    pub window: usize,
    /// Older keyframes that are trained beside them. Peers: 2.
    pub older_views: usize,
    /// Share of the steps that the newest keyframe gets, [0, 1].
    pub newest_share: f32,
    /// Share of the steps that older keyframes get, [0, 1].
    pub older_share: f32,
    /// Chunks have decoders that are learned; the splat backend must have room for them.
    pub learned_decoder: bool,
    /// All chunks have the same decoder, which goes on learning: what that forgets is what chunks of their own keep.
    pub shared_decoder: bool,
    /// Every keyframe has an exposure that is learned beside the map; pictures are never corrected by it.
    pub learned_exposure: bool,
    /// Beyond this, the depth of motion stereo is trusted less, by the square of the distance, m.
    pub trusted_depth_m: f32,
    /// How an optimizer step is taken.
    pub step: StepSettings,
    /// A page leaves when all its keyframes are farther away than this, m.
    pub page_distance_m: f64,
    /// Gaussians fainter than this are dropped when their keyframe leaves the window, [0, 1]. Peers: 0.05.
    pub min_opacity: f32,
    /// Gaussians wider than this share of the image are dropped then, (0, 1]. Peers: half.
    pub max_width_ratio: f32,
}

impl MapperSettings {
    /// Size of the training images relative to those of a camera so wide.
    pub fn resolution_for(&self, camera_width_px: u32) -> f64 {
        self.resolution.max(f64::from(self.min_width_px) / f64::from(camera_width_px.max(1))).min(1.0)
    }

    /// Whether steps look at the depth of keyframes.
    pub fn trains_depth(&self) -> bool {
        self.step.weights.depth > 0.0
    }

    /// The values that the shipped maps were measured with.
    pub fn measured(seed: u64, resolution: f64) -> Self {
        Self {
            seed,
            resolution,
            min_width_px: 600,
            gaussians_per_m: 230.0,
            first_view_m: 20.0,
            insertion: InsertionSettings::MEASURED,
            spawn: SpawnSettings::MEASURED,
            stereo: StereoSettings::MEASURED,
            sparse: SparseSettings::MEASURED,
            min_confidence: 0.05,
            window: 6,
            older_views: 2,
            newest_share: 0.35,
            older_share: 0.15,
            learned_decoder: false,
            shared_decoder: false,
            learned_exposure: false,
            trusted_depth_m: 20.0,
            step: STEP,
            page_distance_m: 100.0,
            min_opacity: 0.05,
            max_width_ratio: 0.5,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_cameras_are_mapped_at_their_own_resolution() {
        for (resolution, camera_width_px, expected) in
            [(0.5, 1241, 0.5), (0.5, 800, 0.75), (0.5, 416, 1.0), (1.0, 1920, 1.0), (0.125, 4800, 0.125)]
        {
            let settings = MapperSettings::measured(0, resolution);
            assert_eq!(settings.resolution_for(camera_width_px), expected, "{camera_width_px}");
        }
    }
}
