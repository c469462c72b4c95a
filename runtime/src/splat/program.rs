//! What a device runs, as data: named buffers planned from the capacities, and stages in the order of the dispatches.
//!
//! Stages are static: which buffers a kernel is bound to never changes, so an executor prepares everything when it
//! opens and only evaluates workgroup counts per run. Every stage sees all writes of the stages before it.

use super::kernel_constants::{
    self as constants, DECODER_PIECES, DIGITS, FEATURE_LEN, GROUP, LOSS_PIECES, N_CANDIDATE_SUMS, N_LOSS_SUMS,
    N_PARAMS, N_SPLAT_GRADS, SCORE_WORDS, SORT_PIECES, TILE_GROUP, TILE_PX,
};
use super::kernels::Kernel;
use super::layout::{Counters, DeviceAnchor, IndirectGroups, KeyframeBlock, Splat, ViewBlock};
use super::{Capacities, DecoderShape, MemoryRow};

mod groups;
mod learn;

pub use groups::{Extent, Stage, WorkSize, Workgroups, check_groups};

/// Declares the buffers: the enum, its names and how large each is.
macro_rules! buffers {
    ($($(#[$doc:meta])* $buffer:ident = $name:literal, $elements:expr, $bytes:expr;)+) => {
        /// A device buffer; its number is its row of [`buffer_plan`].
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Buffer {
            $($(#[$doc])* $buffer,)+
        }

        impl Buffer {
            /// All buffers in the order of their numbers.
            pub const ALL: &'static [Self] = &[$(Self::$buffer),+];
        }

        /// Name and size of every buffer, in the order of [`Buffer::ALL`]; all sizes are multiples of 16 bytes.
        pub fn buffer_plan(capacities: &Capacities) -> [MemoryRow; Buffer::ALL.len()] {
            let sizes = Sizes::of(capacities);
            [$({
                let elements: fn(&Sizes) -> usize = $elements;
                MemoryRow { name: $name, elements: padded(elements(&sizes), $bytes), bytes_per_element: $bytes }
            }),+]
        }
    };
}

buffers! {
    /// The uniform block of every kernel.
    View = "splat.device.view", |_| 1, size_of::<ViewBlock>();
    /// Counters of a run, cleared by the host before it.
    Counters = "splat.device.counters", |_| 1, size_of::<Counters>();
    /// Workgroup counts that kernels find out.
    Dispatch = "splat.device.dispatch", |_| 1, size_of::<IndirectGroups>();
    /// What of an anchor never changes by training.
    Anchors = "splat.device.anchors", |s| s.slots, size_of::<DeviceAnchor>();
    /// Trained numbers, `k` Gaussians per slot.
    Params = "splat.device.params", |s| s.gaussians * N_PARAMS as usize, 4;
    /// Camera from each keyframe row.
    Keyframes = "splat.device.keyframes", |s| s.keyframe_rows, size_of::<KeyframeBlock>();
    /// Which Gaussians of each slot may be in view, one bit each.
    VisibleBits = "splat.device.visible_bits", |s| s.slots, 4;
    /// Candidates of each workgroup of `cull`, then where they begin.
    GroupTotals = "splat.device.group_totals", |s| s.slots.div_ceil(GROUP as usize), 4;
    /// Gaussians that may be in view (`slot * k + i`), ascending.
    Candidates = "splat.device.candidates", |s| s.candidates, 4;
    /// Numbers of the candidates as they are decoded, number by number.
    Effective = "splat.device.effective", |s| s.candidates * N_PARAMS as usize, 4;
    /// Splat of each candidate.
    Splats = "splat.device.splats", |s| s.candidates, size_of::<Splat>();
    /// Sort keys.
    Keys = "splat.device.keys", |s| s.candidates, 4;
    /// Sort keys after every other pass.
    KeysScratch = "splat.device.keys_scratch", |s| s.candidates, 4;
    /// Candidates by depth, nearest first; those that do not meet the picture come last.
    Order = "splat.device.order", |s| s.candidates, 4;
    /// The order after every other pass.
    OrderScratch = "splat.device.order_scratch", |s| s.candidates, 4;
    /// The number 0.
    Digit0 = "splat.device.digit_0", |_| 1, 4;
    /// The number 1.
    Digit1 = "splat.device.digit_1", |_| 1, 4;
    /// The number 2.
    Digit2 = "splat.device.digit_2", |_| 1, 4;
    /// The number 3.
    Digit3 = "splat.device.digit_3", |_| 1, 4;
    /// How often each digit occurs in each piece of the keys.
    DigitCounts = "splat.device.digit_counts", |_| (DIGITS * SORT_PIECES) as usize, 4;
    /// How often each digit occurs.
    DigitTotals = "splat.device.digit_totals", |_| DIGITS as usize, 4;
    /// Where each piece of the depth order begins within the entries of each row of tiles.
    EntryOffsets = "splat.device.entry_offsets", |s| s.tile_rows * GROUP as usize, 4;
    /// Where each row of tiles begins in the entries, and where the last one ends.
    EntryStarts = "splat.device.entry_starts", |s| s.tile_rows + 1, 4;
    /// Splats that meet each row of tiles.
    Entries = "splat.device.entries", |s| s.entries, 8;
    /// Where each piece of a row's entries begins within the pairs of each tile.
    PairOffsets = "splat.device.pair_offsets", |s| s.tiles * TILE_GROUP as usize, 4;
    /// Where each tile begins in the pairs, and where the last one ends.
    TileStarts = "splat.device.tile_starts", |s| s.tiles + 1, 4;
    /// Splats that meet each tile.
    Pairs = "splat.device.pairs", |s| s.pairs, 8;
    /// Red, green, blue, depth, transmittance of the picture, plane by plane.
    Planes = "splat.device.planes", |s| s.pixels * N_PLANES, 4;
    /// Backgrounds of all chunk rows.
    Texels = "splat.device.texels", |s| s.chunk_rows * TEXEL_NUMBERS, 4;
    /// Gradients of the loss with respect to the planes, plane by plane.
    Upstream = "splat.device.upstream", |s| s.training_pixels * N_PLANES, 4;
    /// Largest magnitudes of them.
    Bounds = "splat.device.bounds", |_| 1, 16;
    /// Fixed-point sums of the splats' gradients, two limbs each; 0 between views.
    SplatSums = "splat.device.splat_sums", |s| 2 * s.candidates * N_SPLAT_GRADS as usize, 4;
    /// Anisotropies and gradients of the camera's pose, added up by each workgroup of candidates.
    CandidateSums = "splat.device.candidate_sums", |s| s.candidates.div_ceil(GROUP as usize) * N_CANDIDATE_SUMS as usize, 4;
    /// Fixed-point sums of the texels' gradients, two limbs each; 0 between views.
    TexelSums = "splat.device.texel_sums", |_| 2 * TEXEL_NUMBERS, 4;
    /// Gradients of the texels of the view's chunk row.
    TexelGrads = "splat.device.texel_grads", |_| TEXEL_NUMBERS, 4;
    /// Picture to imitate, as it was given.
    TargetWords = "splat.device.target_words", |s| s.training_pixels * 3, 4;
    /// Depth to imitate, then its confidence.
    TargetDepth = "splat.device.target_depth", |s| s.training_pixels * 2, 4;
    /// Red, green, blue to imitate.
    TargetPlanes = "splat.device.target_planes", |s| s.training_pixels * 3, 4;
    /// Red, green, blue after exposure.
    ExposedPlanes = "splat.device.exposed_planes", |s| s.training_pixels * 3, 4;
    /// Sums of one channel over windows.
    WindowSums = "splat.device.window_sums", |s| s.training_pixels * 5, 4;
    /// Slopes of SSIM with respect to three of them.
    WindowSlopes = "splat.device.window_slopes", |s| s.training_pixels * 3, 4;
    /// Sums of each piece of the pixels.
    LossSums = "splat.device.loss_sums", |_| (LOSS_PIECES * N_LOSS_SUMS) as usize, 4;
    /// Sums of a training view.
    LossReport = "splat.device.loss_report", |_| N_LOSS_SUMS as usize, 4;
    /// Running means of the gradients of `params`.
    ParamFirst = "splat.device.param_first", |s| s.gaussians * N_PARAMS as usize, 4;
    /// Running means of their squares.
    ParamSecond = "splat.device.param_second", |s| s.gaussians * N_PARAMS as usize, 4;
    /// Adam steps of each Gaussian.
    ParamSteps = "splat.device.param_steps", |s| s.gaussians, 4;
    /// Running means of the gradients of `texels`.
    TexelFirst = "splat.device.texel_first", |s| s.chunk_rows * TEXEL_NUMBERS, 4;
    /// Running means of their squares.
    TexelSecond = "splat.device.texel_second", |s| s.chunk_rows * TEXEL_NUMBERS, 4;
    /// Features of the anchors.
    Features = "splat.device.features", |s| s.feature_slots * FEATURE_LEN as usize, 4;
    /// Running means of the features' gradients, of their squares, and the Adam steps, slot by slot.
    FeatureMoments = "splat.device.feature_moments", |s| s.feature_slots * FEATURE_MOMENTS, 4;
    /// Decoders of all chunk rows.
    Decoders = "splat.device.decoders", |s| s.chunk_rows * s.decoder_len, 4;
    /// Running means of the gradients of `decoders`.
    DecoderFirst = "splat.device.decoder_first", |s| s.chunk_rows * s.decoder_len, 4;
    /// Running means of their squares.
    DecoderSecond = "splat.device.decoder_second", |s| s.chunk_rows * s.decoder_len, 4;
    /// Gradients of the decoder that learns, summed over each piece of the candidates; then three numbers for each piece,
    /// the gradient of the camera's place.
    DecoderSums = "splat.device.decoder_sums", |s| DECODER_PIECES as usize * (s.decoder_len + 3), 4;
    /// Scores of the anchors.
    AnchorScores = "splat.device.anchor_scores", |s| s.slots * SCORE_WORDS as usize, 4;
}

/// Red, green, blue, depth, transmittance.
pub const N_PLANES: usize = 5;
/// Numbers of one background table.
pub const TEXEL_NUMBERS: usize = constants::TEXEL_NUMBERS as usize;

/// Numbers that the optimizer remembers about a feature.
pub const FEATURE_MOMENTS: usize = 2 * FEATURE_LEN as usize + 1;

/// What sizes follow from.
struct Sizes {
    slots: usize,
    gaussians: usize,
    keyframe_rows: usize,
    candidates: usize,
    tile_rows: usize,
    tiles: usize,
    entries: usize,
    pairs: usize,
    pixels: usize,
    training_pixels: usize,
    chunk_rows: usize,
    /// Slots with features.
    feature_slots: usize,
    /// Numbers of a chunk row's decoder.
    decoder_len: usize,
}

impl Sizes {
    fn of(capacities: &Capacities) -> Self {
        let [width, height] = [capacities.image_width_px, capacities.image_height_px].map(|v| v as usize);
        let [columns, rows] = [width, height].map(|v| v.div_ceil(TILE_PX as usize));
        let only_if_learned = |n: usize| if capacities.learned_decoder { n } else { 0 };
        Self {
            slots: capacities.anchors,
            gaussians: capacities.anchors * capacities.gaussians_per_anchor,
            keyframe_rows: capacities.keyframe_rows,
            candidates: capacities.visible_gaussians,
            tile_rows: rows,
            tiles: columns * rows,
            entries: capacities.row_entries,
            pairs: capacities.pairs,
            pixels: width * height,
            training_pixels: capacities.training_pixels,
            chunk_rows: capacities.chunk_rows,
            feature_slots: only_if_learned(capacities.anchors),
            decoder_len: only_if_learned(DecoderShape::new(capacities.gaussians_per_anchor).len()),
        }
    }
}

/// Elements so that the bytes are a multiple of 16.
fn padded(elements: usize, bytes: usize) -> usize {
    let factors_of_two = bytes.trailing_zeros().min(4);
    elements.max(1).next_multiple_of(16 >> factors_of_two)
}

impl Buffer {
    /// Name of the buffer in budgets and messages.
    pub fn name(self, plan: &[MemoryRow; Self::ALL.len()]) -> &'static str {
        plan[self as usize].name
    }
}

/// A part of a run; an executor runs several in one submission.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// From anchors to candidates and their stored numbers.
    Project,
    /// What learned decoders add to these.
    Decode,
    /// From numbers to splats.
    MakeSplats,
    /// Splats by depth.
    Sort,
    /// From splats in depth order to the picture.
    Blend,
    /// From [`Buffer::Upstream`] to gradients: those of the candidates' numbers replace the numbers in
    /// [`Buffer::Effective`], those of the background are in [`Buffer::TexelGrads`]. Reports the sums of the loss.
    Backward,
    /// From the picture and the target to [`Buffer::Upstream`].
    Compare,
    /// From the gradients of the picture to how the camera's turning moves the sky.
    TurnSky,
    /// From the picture and what [`Part::Compare`] found to [`Buffer::AnchorScores`]. Reports the sums of the loss.
    Score,
    /// The optimizer's step.
    Step,
    /// From the gradients in [`Buffer::Effective`] to those of the decoder that learns, and the step of features and
    /// decoder.
    StepDecoder,
}

impl Part {
    /// All parts in the order of their numbers.
    pub const ALL: &'static [Self] = &[
        Self::Project,
        Self::Decode,
        Self::MakeSplats,
        Self::Sort,
        Self::Blend,
        Self::Backward,
        Self::Compare,
        Self::TurnSky,
        Self::Score,
        Self::Step,
        Self::StepDecoder,
    ];

    /// The part's dispatches in order.
    pub fn stages(self) -> &'static [Stage] {
        match self {
            Self::Project => PROJECT,
            Self::Decode => DECODE,
            Self::MakeSplats => MAKE_SPLATS,
            Self::Sort => SORT.as_flattened(),
            Self::Blend => BLEND,
            Self::Backward => learn::BACKWARD,
            Self::Compare => learn::COMPARE,
            Self::TurnSky => learn::TURN_SKY,
            Self::Score => learn::SCORE,
            Self::Step => learn::STEP,
            Self::StepDecoder => learn::STEP_DECODER,
        }
    }
}

const fn stage(kernel: Kernel, extent: Extent, buffers: &'static [Buffer]) -> Stage {
    Stage { kernel, buffers, extent }
}

use Buffer as B;

/// An invocation per candidate.
const CANDIDATES: Extent = Extent::Indirect(0);

/// Sorts by one digit.
const fn sort_pass(digit: &'static [Buffer; 4], scatter: &'static [Buffer; 8]) -> [Stage; 3] {
    [
        stage(Kernel::SortCount, Extent::Groups(SORT_PIECES / GROUP), digit),
        stage(Kernel::SortScan, Extent::Groups(1), &[B::DigitCounts, B::DigitTotals]),
        stage(Kernel::SortScatter, Extent::Groups(SORT_PIECES / GROUP), scatter),
    ]
}

macro_rules! sort_pass {
    ($digit:ident, $keys:ident, $order:ident => $next_keys:ident, $next_order:ident) => {
        sort_pass(
            &[B::$digit, B::Counters, B::$keys, B::DigitCounts],
            &[
                B::$digit,
                B::Counters,
                B::$keys,
                B::$order,
                B::DigitCounts,
                B::DigitTotals,
                B::$next_keys,
                B::$next_order,
            ],
        )
    };
}

const SORT: [[Stage; 3]; 4] = [
    sort_pass!(Digit0, Keys, Order => KeysScratch, OrderScratch),
    sort_pass!(Digit1, KeysScratch, OrderScratch => Keys, Order),
    sort_pass!(Digit2, Keys, Order => KeysScratch, OrderScratch),
    sort_pass!(Digit3, KeysScratch, OrderScratch => Keys, Order),
];

/// From anchors to candidates and their numbers.
const PROJECT: &[Stage] = &[
    stage(Kernel::Cull, Extent::Slots, &[B::Anchors, B::Params, B::Keyframes, B::VisibleBits, B::GroupTotals]),
    stage(Kernel::ScanCandidates, Extent::Groups(1), &[B::GroupTotals, B::Counters, B::Dispatch]),
    stage(Kernel::ListCandidates, Extent::Slots, &[B::VisibleBits, B::GroupTotals, B::Candidates]),
    stage(Kernel::GatherParams, CANDIDATES, &[B::Params, B::Candidates, B::Counters, B::Effective]),
];

/// What learned decoders add to the numbers.
const DECODE: &[Stage] = &[stage(
    Kernel::DecodeAnchors,
    CANDIDATES,
    &[B::Anchors, B::Keyframes, B::Candidates, B::Counters, B::Features, B::Decoders, B::Effective],
)];

/// From numbers to splats.
const MAKE_SPLATS: &[Stage] = &[stage(
    Kernel::MakeSplats,
    CANDIDATES,
    &[B::Anchors, B::Keyframes, B::Candidates, B::Effective, B::Counters, B::Splats, B::Keys, B::Order],
)];

/// From splats in depth order to the picture.
const BLEND: &[Stage] = &[
    stage(Kernel::CountEntries, Extent::TileRows, &[B::Counters, B::Order, B::Splats, B::EntryOffsets, B::EntryStarts]),
    stage(Kernel::ScanEntries, Extent::Groups(1), &[B::EntryStarts, B::Counters]),
    stage(
        Kernel::ListEntries,
        Extent::TileRows,
        &[B::Counters, B::Order, B::Splats, B::EntryOffsets, B::EntryStarts, B::Entries],
    ),
    stage(Kernel::CountPairs, Extent::Tiles, &[B::EntryStarts, B::Entries, B::PairOffsets, B::TileStarts]),
    stage(Kernel::ScanPairs, Extent::Groups(1), &[B::TileStarts, B::Counters]),
    stage(
        Kernel::ListPairs,
        Extent::Tiles,
        &[B::Splats, B::EntryStarts, B::Entries, B::PairOffsets, B::TileStarts, B::Pairs, B::Counters],
    ),
    stage(Kernel::Blend, Extent::Blocks, &[B::Splats, B::TileStarts, B::Pairs, B::Planes]),
    stage(Kernel::ComposeSky, Extent::Pixels, &[B::Texels, B::Planes]),
];
