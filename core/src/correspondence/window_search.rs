//! Shifts deformed windows to where they fit best on one level, there and back.

use crate::features::affine::Placement;
use crate::features::lanes::Kernel;
use crate::features::lk::{descend, squared_distance};
use crate::features::window::Template;
use crate::frame::pyramid::PaddedImage;

/// Constants of the search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WindowSettings {
    /// Newton steps per level at most. Range 1..=100; ours.
    pub max_steps: u32,
    /// A step shorter than this ends the search on a level, px of the level. Range (0, 0.5]; ours.
    pub converged_px: f32,
    /// Correlation of two windows below which they do not show the same. Range [-1, 1]; ours.
    pub min_correlation: f32,
    /// How far the way back may end from where the way there began, px of the level. Range (0, 10]; ours.
    pub max_backward_px: f32,
}

impl WindowSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self { max_steps: 15, converged_px: 0.02, min_correlation: 0.6, max_backward_px: 1.0 };
}

/// Where a window is and is expected, px of the full images.
pub(super) struct Expected {
    pub(super) keyframe_px: [f32; 2],
    pub(super) current_px: [f32; 2],
    /// How offsets are deformed: rows of the linear map.
    pub(super) shape: [[f32; 2]; 2],
}

/// Where a window was found.
pub(super) struct Found {
    /// Px of the full image.
    pub(super) current_px: [f32; 2],
    pub(super) correlation: f32,
    /// Expected standard deviation of `current_px`, of the worst direction.
    pub(super) sigma_px: f32,
}

/// Noise of a level is not white: its windows know their place by so much less.
const CORRELATED: f32 = 1.6;

/// By how many times contrast may grow or shrink before steps are no longer adapted to it.
const MOST_CONTRAST: f32 = 16.0;

/// Searches `current` on `level` of both images; `None` when the window leaves them, is flat or does not come back.
#[inline(always)]
pub(super) fn search<K: Kernel>(
    kernel: K,
    [keyframe, current]: [&PaddedImage<'_>; 2],
    level: usize,
    settings: &WindowSettings,
    expected: &Expected,
) -> Option<Found> {
    let scale = (1u32 << level) as f32;
    let to_level = |px: [f32; 2]| px.map(|c| c / scale);
    let (source_px, start_px) = (to_level(expected.keyframe_px), to_level(expected.current_px));
    let mut there = Template::NONE;
    there.take_deformed(kernel, keyframe, &Placement { center_px: source_px, shape: inverse(expected.shape)? })?;
    let contrast = there.contrast(kernel, current, start_px)?;
    let step_scale = (1.0 / contrast).clamp(1.0 / MOST_CONTRAST, MOST_CONTRAST);
    let target_px = descend(kernel, &there, current, start_px, step_scale, settings.max_steps, settings.converged_px)?;
    let correlation = there.correlation(kernel, current, target_px)?;
    let noise_px = there.sigma_px(kernel, correlation)? * CORRELATED;

    let mut back = Template::NONE;
    back.take_deformed(kernel, current, &Placement { center_px: target_px, shape: expected.shape })?;
    // As far off as the way there began, so that it does not know the answer.
    let back_start_px = [0, 1].map(|k: usize| source_px[k] + target_px[k] - start_px[k]);
    let back_px =
        descend(kernel, &back, keyframe, back_start_px, 1.0 / step_scale, settings.max_steps, settings.converged_px)?;
    let missed2 = squared_distance(back_px, source_px);
    if missed2 > settings.max_backward_px * settings.max_backward_px {
        return None;
    }
    // Both ways have seen the same noise, so their middle is hardly better and their distance tells of other errors.
    let [[a, b], [c, d]] = expected.shape;
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
