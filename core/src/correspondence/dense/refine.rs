//! Shifts deformed windows to where they fit best, one level at a time, there and back.

use super::DenseSettings;
use super::field::DenseNode;
use crate::correspondence::ImagePair;
use crate::features::SimdLevel;
use crate::features::affine::Placement;
use crate::features::lanes::{Kernel, KernelTask};
use crate::features::lk::{descend, is_inside, squared_distance};
use crate::features::window::Template;
use crate::frame::pyramid::PaddedImage;

/// How close to the border of the image a match may lie, px: half a window of the tracker.
const BORDER_PX: f32 = 11.0;

/// Noise of a level is not white: its windows know their place by so much less.
const CORRELATED: f32 = 1.6;

/// By how many times contrast may grow or shrink before steps are no longer adapted to it.
const MOST_CONTRAST: f32 = 16.0;

/// Moves every live node to where it fits best on `level`; nodes that find nothing die, except on the full image,
/// where they stay as they are.
pub(super) fn refine(
    simd: SimdLevel,
    pair: &ImagePair<'_>,
    level: usize,
    settings: &DenseSettings,
    nodes: &mut [DenseNode],
) {
    let (Some(keyframe), Some(current)) = (pair.keyframe.level(level), pair.current.level(level)) else { return };
    simd.run(Refine { pair, keyframe, current, level, settings, nodes });
}

struct Refine<'a> {
    pair: &'a ImagePair<'a>,
    keyframe: PaddedImage<'a>,
    current: PaddedImage<'a>,
    level: usize,
    settings: &'a DenseSettings,
    nodes: &'a mut [DenseNode],
}

/// A node on one level.
struct Found {
    current_px: [f32; 2],
    correlation: f32,
    sigma_px: f32,
}

impl KernelTask for Refine<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Self { pair, keyframe, current, level, settings, nodes } = self;
        for node in nodes.iter_mut().filter(|node| node.is_alive) {
            let found = search(kernel, [&keyframe, &current], level, settings, node)
                .filter(|found| is_inside(pair.current, found.current_px, BORDER_PX))
                .filter(|_| is_inside(pair.keyframe, node.keyframe_px, BORDER_PX));
            match found {
                Some(found) if level > 0 || node.sigma_px == f32::INFINITY => {
                    (node.current_px, node.correlation, node.sigma_px) =
                        (found.current_px, found.correlation, found.sigma_px);
                    node.is_alive = found.correlation >= settings.min_correlation;
                }
                // Where noise hides the detail, the coarser level knows better.
                Some(found) if found.sigma_px < node.sigma_px => {
                    (node.current_px, node.sigma_px) = (found.current_px, found.sigma_px);
                }
                Some(_) => {}
                None => node.is_alive = level == 0 && node.sigma_px.is_finite(),
            }
            node.is_alive &= level > 0 || node.sigma_px <= settings.max_sigma_px;
        }
    }
}

#[inline(always)]
fn search<K: Kernel>(
    kernel: K,
    [keyframe, current]: [&PaddedImage<'_>; 2],
    level: usize,
    settings: &DenseSettings,
    node: &DenseNode,
) -> Option<Found> {
    let scale = (1u32 << level) as f32;
    let to_level = |px: [f32; 2]| px.map(|c| c / scale);
    let (source_px, start_px) = (to_level(node.keyframe_px), to_level(node.current_px));
    let there = Template::deformed(kernel, keyframe, &Placement { center_px: source_px, shape: inverse(node.shape)? })?;
    let contrast = there.contrast(kernel, current, start_px)?;
    let step_scale = (1.0 / contrast).clamp(1.0 / MOST_CONTRAST, MOST_CONTRAST);
    let target_px = descend(kernel, &there, current, start_px, step_scale, settings.max_steps, settings.converged_px)?;
    let correlation = there.correlation(kernel, current, target_px)?;
    let noise_px = there.sigma_px(kernel, correlation)? * CORRELATED;

    let back = Template::deformed(kernel, current, &Placement { center_px: target_px, shape: node.shape })?;
    // As far off as the way there began, so that it does not know the answer.
    let back_start_px = [0, 1].map(|k: usize| source_px[k] + target_px[k] - start_px[k]);
    let back_px =
        descend(kernel, &back, keyframe, back_start_px, 1.0 / step_scale, settings.max_steps, settings.converged_px)?;
    let missed2 = squared_distance(back_px, source_px);
    if missed2 > settings.max_backward_px * settings.max_backward_px {
        return None;
    }
    // Both ways have seen the same noise, so their middle is hardly better and their distance tells of other errors.
    let [[a, b], [c, d]] = node.shape;
    let [dx, dy] = [0, 1].map(|k: usize| MIDDLE * (source_px[k] - back_px[k]));
    let middle_px = [target_px[0] + a * dx + b * dy, target_px[1] + c * dx + d * dy];
    let sigma_px = kernel.sqrt((noise_px * noise_px + MIDDLE * MIDDLE * missed2).into()) as f32;
    Some(Found { current_px: middle_px.map(|c| c * scale), correlation, sigma_px: sigma_px * scale })
}

const MIDDLE: f32 = 0.5;

#[inline(always)]
fn inverse([[a, b], [c, d]]: [[f32; 2]; 2]) -> Option<[[f32; 2]; 2]> {
    /// A window is not to shrink to a tenth of its area, nor turn over.
    const MIN_DETERMINANT: f32 = 0.1;
    let determinant = a * d - b * c;
    (determinant > MIN_DETERMINANT).then(|| [[d / determinant, -b / determinant], [-c / determinant, a / determinant]])
}
