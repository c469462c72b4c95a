//! The kernel table: every kernel of the device backends, with its WGSL text, its bindings and its workgroup size.
//!
//! `runtime/build.rs` compiles this table to SPIR-V and the wgpu executor hands the same text to its device, so this
//! file depends on nothing but its constants. Binding 0 of every kernel is the uniform block `view`; the table
//! lists what follows.

use super::kernel_constants::{self as constants, BLEND_GROUP, DIGITS, GROUP, LOSS_PIECES, SORT_PIECES, TILE_GROUP};

/// How a kernel touches a buffer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    ReadWrite,
}

/// A storage buffer of a kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Binding {
    /// Name of the WGSL variable.
    pub name: &'static str,
    /// How it is touched.
    pub access: Access,
}

/// One row of the kernel table.
#[derive(Clone, Copy, Debug)]
pub struct KernelSpec {
    /// File name without `.wgsl`; the entry point is `main`.
    pub name: &'static str,
    /// Storage buffers in the order of their binding numbers, from 1 on.
    pub bindings: &'static [Binding],
    /// Invocations of a workgroup, one-dimensional.
    pub workgroup_size: u32,
    /// Files under `shaders/` with their text, in the order in which they are joined.
    files: &'static [(&'static str, &'static str)],
}

const fn read(name: &'static str) -> Binding {
    Binding { name, access: Access::Read }
}

const fn write(name: &'static str) -> Binding {
    Binding { name, access: Access::ReadWrite }
}

/// Declares the kernels: the enum, and the table in the same order.
macro_rules! kernels {
    ($($(#[$doc:meta])* $kernel:ident = $name:literal, $size:expr, [$($shared:literal),*], [$($access:ident $binding:ident),*];)+) => {
        /// A kernel; its number is its row of [`KERNELS`].
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Kernel {
            $($(#[$doc])* $kernel,)+
        }

        /// The kernel table.
        pub const KERNELS: &[KernelSpec] = &[
            $(KernelSpec {
                name: $name,
                bindings: &[$($access(stringify!($binding))),*],
                workgroup_size: $size,
                files: &[
                    ("shaders/shared/view.wgsl", include_str!("../../../shaders/shared/view.wgsl")),
                    $((
                        concat!("shaders/shared/", $shared, ".wgsl"),
                        include_str!(concat!("../../../shaders/shared/", $shared, ".wgsl")),
                    ),)*
                    (concat!("shaders/", $name, ".wgsl"), include_str!(concat!("../../../shaders/", $name, ".wgsl"))),
                ],
            },)+
        ];
    };
}

kernels! {
    /// Which Gaussians of each slot may be in view.
    Cull = "cull", GROUP, ["anchor", "lod", "side", "group_scan", "scan"],
        [read anchors, read params, read keyframes, write visible_bits, write group_totals];
    /// Where each workgroup's candidates begin, and how many there are.
    ScanCandidates = "scan_candidates", GROUP, ["counters", "group_scan", "scan"],
        [write group_totals, write counters, write dispatch];
    /// Gaussians that may be in view, ascending.
    ListCandidates = "list_candidates", GROUP, ["group_scan", "scan"],
        [read visible_bits, read group_totals, write candidates];
    /// Numbers of every candidate as they are stored.
    GatherParams = "gather_params", GROUP, ["counters"],
        [read params, read candidates, read counters, write effective];
    /// Adds what each chunk's learned decoder makes of its anchors to the numbers of their candidates.
    DecodeAnchors = "decode_anchors", GROUP, ["counters", "anchor", "exponential", "group_scan", "scan", "seen"],
        [read anchors, read keyframes, read candidates, read counters, read features, read decoders, write effective];
    /// Splat and sort key of every candidate.
    MakeSplats = "make_splats", GROUP,
        ["counters_atomic", "anchor", "lod", "side", "exponential", "decode", "effective", "project", "splat"],
        [read anchors, read keyframes, read candidates, read effective, write counters, write splats, write keys,
         write order];
    /// How often each digit occurs in each piece of the keys.
    SortCount = "sort_count", GROUP, ["counters"], [read digit, read counters, read keys, write digit_counts];
    /// Where each piece's keys begin within their digit.
    SortScan = "sort_scan", GROUP, [], [write digit_counts, write digit_totals];
    /// Moves the keys.
    SortScatter = "sort_scatter", GROUP, ["counters", "group_scan", "scan"],
        [read digit, read counters, read keys, read order, write digit_counts, read digit_totals, write next_keys,
         write next_order];
    /// How many splats meet a row of tiles.
    CountEntries = "count_entries", GROUP, ["counters", "splat", "group_scan", "scan"],
        [read counters, read order, read splats, write entry_offsets, write entry_starts];
    /// Where each row of tiles begins in the list of entries.
    ScanEntries = "scan_entries", GROUP, ["counters", "group_scan", "scan"], [write entry_starts, write counters];
    /// Splats that meet each row of tiles, by depth.
    ListEntries = "list_entries", GROUP, ["counters", "splat", "ellipse", "entry"],
        [read counters, read order, read splats, read entry_offsets, read entry_starts, write entries];
    /// How many entries meet a tile.
    CountPairs = "count_pairs", TILE_GROUP, ["entry", "tile_scan", "scan"],
        [read entry_starts, read entries, write pair_offsets, write tile_starts];
    /// Where each tile begins in the list of pairs.
    ScanPairs = "scan_pairs", GROUP, ["counters", "group_scan", "scan"], [write tile_starts, write counters];
    /// Splats that meet each tile, by depth, with the blocks that they touch.
    ListPairs = "list_pairs", TILE_GROUP, ["counters_atomic", "splat", "ellipse", "entry", "pair"],
        [read splats, read entry_starts, read entries, read pair_offsets, read tile_starts, write pairs,
         write counters];
    /// Front-to-back blending over nothing.
    Blend = "blend", BLEND_GROUP, ["splat", "pair", "exponential", "hit"], [read splats, read tile_starts, read pairs, write planes];
    /// Puts the background behind the picture.
    ComposeSky = "compose_sky", GROUP, ["sky"], [read texels, write planes];
    /// Largest magnitudes of the loss gradient.
    BoundGradients = "bound_gradients", GROUP, ["bounds_atomic"], [read planes, read upstream, write bounds];
    /// Gradients of blending, summed per splat.
    BlendBackward = "blend_backward", BLEND_GROUP, ["splat", "pair", "exponential", "hit", "bounds", "fixed"],
        [read splats, read tile_starts, read pairs, read planes, read upstream, read bounds, write splat_sums];
    /// Gradients with respect to the numbers of every candidate, and with respect to the camera's pose.
    SplattingBackward = "splatting_backward", GROUP,
        ["counters", "anchor", "exponential", "decode", "effective", "project", "project_backward", "splat", "bounds", "fixed", "lod", "side"],
        [read anchors, read keyframes, read candidates, read counters, read splats, read bounds, write splat_sums,
         write effective, write candidate_sums];
    /// Sums of the gradients of the decoder that learns and of the camera's place, and the Adam step of the features.
    DecodeAnchorsBackward = "decode_anchors_backward", GROUP,
        ["counters", "anchor", "exponential", "group_scan", "scan", "seen", "adam"],
        [read anchors, read keyframes, read candidates, read counters, write features, read decoders, read effective,
         write feature_moments, write decoder_sums];
    /// Spreads the gradients of the background over its texels.
    SpreadSky = "spread_sky", GROUP, ["bounds", "texel_fixed", "sky"],
        [read planes, read upstream, read bounds, write texel_sums];
    /// How the rays of the pixels would turn the sky.
    TurnSky = "turn_sky", GROUP, ["sky"], [read planes, read upstream, read texels, write loss_sums];
    /// Gradients of the texels.
    CollectSky = "collect_sky", GROUP, ["bounds", "texel_fixed"], [read bounds, write texel_sums, write texel_grads];
    /// Terms of the loss that look at one pixel, and where its gradients begin.
    ComparePixels = "compare_pixels", GROUP, [],
        [read target_words, read target_depth, read planes, write target_planes, write exposed_planes,
         write upstream, write loss_sums];
    /// Row sums of one channel's windows.
    SsimRows = "ssim_rows", GROUP, ["window", "row_strip"],
        [read channel, read exposed_planes, read target_planes, write window_sums];
    /// SSIM of one channel and its slopes.
    SsimCompare = "ssim_compare", GROUP, ["window", "column_strip"],
        [read window_sums, write window_slopes, write loss_sums];
    /// Column sums of the slopes.
    SsimColumns = "ssim_columns", GROUP, ["window", "column_strip"], [read window_slopes, write window_sums];
    /// Gradients of one channel's SSIM.
    SsimCollect = "ssim_collect", GROUP, ["window", "row_strip"],
        [read channel, read exposed_planes, read target_planes, read window_sums, write upstream];
    /// Gradients of the exposure, and of the picture before it.
    ThroughExposure = "through_exposure", GROUP, [], [read planes, write upstream, write loss_sums];
    /// Sums of a training view.
    ReduceLoss = "reduce_loss", GROUP, ["counters"],
        [read counters, read loss_sums, read candidate_sums, write loss_report];
    /// What each anchor contributes to the picture, and how much of that is wrong.
    ScoreAnchors = "score_anchors", BLEND_GROUP, ["counters_atomic", "splat", "pair", "exponential", "hit"],
        [read splats, read tile_starts, read pairs, read candidates, read exposed_planes, read target_planes,
         write counters, write anchor_scores];
    /// How large each anchor is on the picture.
    MeasureAnchors = "measure_anchors", GROUP, ["counters", "splat"],
        [read counters, read candidates, read splats, write anchor_scores];
    /// Adam step of the visible Gaussians' stored numbers.
    StepParams = "step_params", GROUP, ["counters", "splat", "adam"],
        [read counters, read candidates, read splats, read effective, write params, write param_first,
         write param_second, write param_steps];
    /// Adam step of the decoder that learns.
    StepDecoder = "step_decoder", GROUP, ["adam"],
        [read decoder_sums, write decoders, write decoder_first, write decoder_second];
    /// Adam step of the background.
    StepSky = "step_sky", GROUP, ["adam"], [read texel_grads, write texels, write texel_first, write texel_second];
}

impl Kernel {
    /// Row of the kernel table.
    pub fn spec(self) -> &'static KernelSpec {
        &KERNELS[self as usize]
    }
}

impl KernelSpec {
    /// The kernel's whole WGSL text: constants, the uniform block, its shared snippets, its file.
    pub fn wgsl(&self) -> String {
        self.pieces().map(|(_, text)| text).collect()
    }

    /// The same in pieces, each with the file that it is from.
    pub fn pieces(&self) -> impl Iterator<Item = (&'static str, String)> {
        let constants = ("runtime/src/splat/kernel_constants.rs", constants::wgsl());
        std::iter::once(constants).chain(self.files.iter().map(|&(file, text)| (file, text.to_owned())))
    }
}

const _: () =
    assert!(DIGITS == GROUP && SORT_PIECES.is_multiple_of(GROUP), "sorting has an invocation per digit and piece");
const _: () = assert!(LOSS_PIECES.is_multiple_of(GROUP), "losses have an invocation per piece");
const _: () = assert!(BLEND_GROUP <= 256 && GROUP <= 256, "devices promise no more than 256 invocations");
