//! The dispatches of a training step that follow the picture.

use super::{Buffer as B, CANDIDATES, Extent, Stage, TEXEL_NUMBERS, stage};
use crate::splat::DecoderShape;
use crate::splat::capacity::MAX_GAUSSIANS_PER_ANCHOR;
use crate::splat::kernel_constants::{DECODER_PIECES, GROUP, LOSS_PIECES, N_LOSS_SUMS};
use crate::splat::kernels::Kernel;

/// An invocation per piece of the pixels.
const PIECES: Extent = Extent::Groups(LOSS_PIECES / GROUP);

/// An invocation per number of a background table.
const TEXEL_GROUPS: Extent = Extent::Groups((TEXEL_NUMBERS as u32).div_ceil(GROUP));

/// SSIM of the channel that a buffer holds.
macro_rules! ssim {
    ($channel:ident) => {
        [
            stage(Kernel::SsimRows, PIECES, &[B::$channel, B::ExposedPlanes, B::TargetPlanes, B::WindowSums]),
            stage(Kernel::SsimCompare, PIECES, &[B::WindowSums, B::WindowSlopes, B::LossSums]),
            stage(Kernel::SsimColumns, PIECES, &[B::WindowSlopes, B::WindowSums]),
            stage(
                Kernel::SsimCollect,
                PIECES,
                &[B::$channel, B::ExposedPlanes, B::TargetPlanes, B::WindowSums, B::Upstream],
            ),
        ]
    };
}

const RED: [Stage; 4] = ssim!(Digit0);
const GREEN: [Stage; 4] = ssim!(Digit1);
const BLUE: [Stage; 4] = ssim!(Digit2);

/// From the picture and the target to gradients with respect to the picture.
pub const COMPARE: &[Stage] = &[
    stage(
        Kernel::ComparePixels,
        PIECES,
        &[B::TargetWords, B::TargetDepth, B::Planes, B::TargetPlanes, B::ExposedPlanes, B::Upstream, B::LossSums],
    ),
    RED[0],
    RED[1],
    RED[2],
    RED[3],
    GREEN[0],
    GREEN[1],
    GREEN[2],
    GREEN[3],
    BLUE[0],
    BLUE[1],
    BLUE[2],
    BLUE[3],
    stage(Kernel::ThroughExposure, PIECES, &[B::Planes, B::Upstream, B::LossSums]),
];

/// From gradients of the picture to gradients of everything that is trained.
pub const BACKWARD: &[Stage] = &[
    stage(Kernel::BoundGradients, Extent::Pixels, &[B::Planes, B::Upstream, B::Bounds]),
    stage(
        Kernel::BlendBackward,
        Extent::Blocks,
        &[B::Splats, B::TileStarts, B::Pairs, B::Planes, B::Upstream, B::Bounds, B::SplatSums],
    ),
    stage(
        Kernel::SplattingBackward,
        CANDIDATES,
        &[
            B::Anchors,
            B::Keyframes,
            B::Candidates,
            B::Counters,
            B::Splats,
            B::Bounds,
            B::SplatSums,
            B::Effective,
            B::CandidateSums,
        ],
    ),
    stage(Kernel::SpreadSky, Extent::Pixels, &[B::Planes, B::Upstream, B::Bounds, B::TexelSums]),
    stage(Kernel::CollectSky, TEXEL_GROUPS, &[B::Bounds, B::TexelSums, B::TexelGrads]),
    REDUCE_LOSS,
];

const REDUCE_LOSS: Stage = stage(
    Kernel::ReduceLoss,
    Extent::Groups(N_LOSS_SUMS),
    &[B::Counters, B::LossSums, B::CandidateSums, B::LossReport],
);

/// From the gradients of the picture to how the camera's turning moves the sky; before [`BACKWARD`] adds up the sums.
pub const TURN_SKY: &[Stage] = &[stage(Kernel::TurnSky, PIECES, &[B::Planes, B::Upstream, B::Texels, B::LossSums])];

/// Scores of the anchors.
pub const SCORE: &[Stage] = &[
    stage(
        Kernel::ScoreAnchors,
        Extent::Blocks,
        &[
            B::Splats,
            B::TileStarts,
            B::Pairs,
            B::Candidates,
            B::ExposedPlanes,
            B::TargetPlanes,
            B::Counters,
            B::AnchorScores,
        ],
    ),
    stage(Kernel::MeasureAnchors, CANDIDATES, &[B::Counters, B::Candidates, B::Splats, B::AnchorScores]),
    REDUCE_LOSS,
];

/// The optimizer's step.
pub const STEP: &[Stage] = &[
    stage(
        Kernel::StepParams,
        CANDIDATES,
        &[B::Counters, B::Candidates, B::Splats, B::Effective, B::Params, B::ParamFirst, B::ParamSecond, B::ParamSteps],
    ),
    stage(Kernel::StepSky, TEXEL_GROUPS, &[B::TexelGrads, B::Texels, B::TexelFirst, B::TexelSecond]),
];

/// An invocation per number of the largest decoder.
const DECODER_GROUPS: Extent =
    Extent::Groups((DecoderShape::new(MAX_GAUSSIANS_PER_ANCHOR).len() as u32).div_ceil(GROUP));

/// The step of features and decoder.
pub const STEP_DECODER: &[Stage] = &[
    stage(
        Kernel::DecodeAnchorsBackward,
        Extent::Groups(DECODER_PIECES),
        &[
            B::Anchors,
            B::Keyframes,
            B::Candidates,
            B::Counters,
            B::Features,
            B::Decoders,
            B::Effective,
            B::FeatureMoments,
            B::DecoderSums,
        ],
    ),
    stage(Kernel::StepDecoder, DECODER_GROUPS, &[B::DecoderSums, B::Decoders, B::DecoderFirst, B::DecoderSecond]),
];
