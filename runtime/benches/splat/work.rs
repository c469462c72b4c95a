//! The least that each stage of a training step must read, write and compute, whoever computes it.
//!
//! Every input is read once and every output written once; nothing is said of intermediate results. The counts of
//! operations are those of the formulas (a multiply-add is two), exponentials and roots counted as 10.

use crate::scene::{GAUSSIANS_PER_ANCHOR, Size};
use kilogs::splat::{AnchorHeader, DecoderShape, GaussianParams, RenderStats};
use kilogs_core::map::decoder::{FEATURE_LEN, HIDDEN, INPUTS};

/// Bytes and operations.
#[derive(Clone, Copy)]
pub struct Work {
    /// Bytes read and written.
    pub bytes: f64,
    /// Single-precision operations.
    pub flops: f64,
}

/// What the formulas count in.
#[derive(Clone, Copy)]
pub struct Counts {
    /// Gaussians of the map.
    pub gaussians: f64,
    /// Gaussians on the picture.
    pub visible: f64,
    /// Gaussian-tile pairs.
    pub pairs: f64,
    /// Gaussian-pixel contributions.
    pub contributions: f64,
    /// Pixels.
    pub pixels: f64,
}

impl Counts {
    /// Of a view of a scene.
    pub fn new(size: &Size, stats: &RenderStats, contributions: f64) -> Self {
        Self {
            gaussians: size.n_gaussians as f64,
            visible: f64::from(stats.visible),
            pairs: f64::from(stats.pairs),
            contributions,
            pixels: size.n_pixels() as f64,
        }
    }
}

/// Trained numbers of a Gaussian with its share of the anchor.
const GAUSSIAN_BYTES: f64 = (size_of::<GaussianParams>() + size_of::<AnchorHeader>() / GAUSSIANS_PER_ANCHOR) as f64;
/// Adam keeps two numbers for each.
const MOMENT_BYTES: f64 = 2.0 * size_of::<GaussianParams>() as f64;
/// Mean 2, conic 3, color 3, opacity, depth.
const SPLAT_BYTES: f64 = 40.0;
/// Gradients of the same numbers.
const SPLAT_GRADIENT_BYTES: f64 = 40.0;
/// Index of a splat.
const PAIR_BYTES: f64 = 4.0;
/// Depth and index.
const KEY_BYTES: f64 = 8.0;
/// Red, green, blue, depth, transmittance.
const DRAWN_BYTES: f64 = 20.0;
/// Red, green, blue of the camera.
const TARGET_BYTES: f64 = 3.0;

/// Offset to camera coordinates and the test against the pyramid.
const CULL_FLOPS: f64 = 60.0;
/// Decoding, covariance, Jacobian, conic (Zwicker et al. 2002).
const PROJECT_FLOPS: f64 = 350.0;
/// Distance, exponent, alpha, five blended numbers.
const BLEND_FLOPS: f64 = 34.0;
/// The same again, and ten gradients.
const BLEND_BACKWARD_FLOPS: f64 = 80.0;
/// Three channels, eight filtered planes (five forward, three back), twice eleven taps.
const SSIM_FLOPS: f64 = 3.0 * 8.0 * 2.0 * 11.0 * 2.0;
/// Backward of projection and decoding, forward once more, and Adam for 14 numbers.
const UPDATE_FLOPS: f64 = 1100.0;
/// Direction of a ray, two coordinates of the table, four texels.
const SKY_FLOPS: f64 = 80.0;

/// A Gaussian's share of its anchor's feature.
const FEATURE_BYTES: f64 = (FEATURE_LEN * size_of::<f32>() / GAUSSIANS_PER_ANCHOR) as f64;
/// A Gaussian's share of both layers; on the way back twice that, and the first layer once more.
const DECODER_FLOPS: f64 =
    2.0 * (HIDDEN * (INPUTS + DecoderShape::new(GAUSSIANS_PER_ANCHOR).outputs) / GAUSSIANS_PER_ANCHOR) as f64;

/// The least work of a stage; `None` for stages that this page does not know.
pub fn least_work(stage: &str, n: &Counts) -> Option<Work> {
    let work = |bytes: f64, flops: f64| Some(Work { bytes, flops });
    match stage {
        "cull" => work(n.gaussians * GAUSSIAN_BYTES, n.gaussians * CULL_FLOPS),
        // Every anchor of the scenes is in view: features and stored numbers in, numbers out.
        "decode" | "decode_anchors" => work(
            n.gaussians * (FEATURE_BYTES + GAUSSIAN_BYTES + size_of::<GaussianParams>() as f64),
            n.gaussians * DECODER_FLOPS,
        ),
        "decode_backward" | "decode_anchors_backward" => work(
            n.gaussians * (6.0 * FEATURE_BYTES + size_of::<GaussianParams>() as f64),
            n.gaussians * 2.5 * DECODER_FLOPS,
        ),
        "project" => work(n.visible * (GAUSSIAN_BYTES + SPLAT_BYTES + KEY_BYTES), n.visible * PROJECT_FLOPS),
        "sort" => work(n.visible * 2.0 * KEY_BYTES, 0.0),
        "bin" => work(n.visible * SPLAT_BYTES + n.pairs * PAIR_BYTES, n.visible * 20.0),
        "blend" => work(
            n.pairs * (PAIR_BYTES + SPLAT_BYTES) + n.pixels * DRAWN_BYTES,
            n.contributions * BLEND_FLOPS + n.pixels * SKY_FLOPS,
        ),
        "loss" => work(n.pixels * (2.0 * DRAWN_BYTES + TARGET_BYTES), n.pixels * (SSIM_FLOPS + 60.0)),
        "blend_backward" => work(
            n.pairs * (PAIR_BYTES + SPLAT_BYTES) + n.pixels * 2.0 * DRAWN_BYTES + n.visible * SPLAT_GRADIENT_BYTES,
            n.contributions * BLEND_BACKWARD_FLOPS,
        ),
        // How the directions change, on top of the lookup.
        "sky_turn" => work(n.pixels * 2.0 * DRAWN_BYTES, n.pixels * (SKY_FLOPS + 40.0)),
        // Distance, exponent, alpha and two counts; a mark per pixel.
        "score" => work(
            n.pairs * (PAIR_BYTES + SPLAT_BYTES) + n.pixels * size_of::<f32>() as f64,
            n.contributions * (BLEND_FLOPS - 6.0),
        ),
        "sky" => work(n.pixels * 2.0 * DRAWN_BYTES, n.pixels * SKY_FLOPS),
        "update" => {
            work(n.visible * (SPLAT_GRADIENT_BYTES + 2.0 * (GAUSSIAN_BYTES + MOMENT_BYTES)), n.visible * UPDATE_FLOPS)
        }
        _ => None,
    }
}
