//! Pyramidal Lucas-Kanade: where did a point go?

use super::lanes::{Kernel, KernelTask, SimdLevel};
use super::window::{Template, WINDOW};
use crate::frame::Pyramid;
use crate::frame::pyramid::PaddedImage;

/// Constants of the search.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LkSettings {
    /// Pyramid levels that are searched, the full image included. Range 1..=6; 4 in the paper's supplement.
    /// Levels smaller than the window are left out.
    pub n_levels: u32,
    /// Newton steps per level at most. Range 1..=100; 30 is OpenCV's default.
    pub max_steps: u32,
    /// A step shorter than this ends the search on the full image, px. Range (0, 0.5]; OpenCV's default is 0.01.
    pub converged_px: f32,
    /// The same on the coarser levels, px of the level: they only have to bring the next level into reach.
    /// Range (0, 0.5]; ours.
    pub coarse_converged_px: f32,
    /// Smallest eigenvalue of the mean gradient matrix below which a window is flat, squared grey values per
    /// squared pixel. Range [0, 1000]; ours: 8-bit noise of one grey value gives about 0.3.
    pub min_eigenvalue: f32,
    /// Correlation of the two windows below which they do not show the same. Range [-1, 1]; ours: on KITTI 04, 0.7
    /// leaves 40 % more matches within 0.3 px of the epipolar line than 0.8.
    pub min_correlation: f32,
    /// How far the way back may end from where the way there began, px. Range (0, 10]; ours (peers use 0.5-1).
    pub max_backward_px: f32,
    /// How close to the border a point may lie, px. Range [0, 100]; the part of a window that hangs over the
    /// border sees replicated pixels. Ours.
    pub border_px: f32,
}

impl LkSettings {
    /// The values that the documentation of the fields explains.
    pub const STANDARD: Self = Self {
        n_levels: 4,
        max_steps: 30,
        converged_px: 0.01,
        coarse_converged_px: 0.03,
        min_eigenvalue: 1.0,
        min_correlation: 0.7,
        max_backward_px: 0.5,
        border_px: 11.0,
    };
}

/// What became of one point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LkVerdict {
    /// Not searched for yet.
    Pending,
    /// Found.
    Found {
        /// Correlation of the two windows, in [-1, 1].
        correlation: f32,
        /// Smallest eigenvalue of the mean gradient matrix, squared grey values per squared pixel.
        min_eigenvalue: f32,
    },
    /// The window has no corner to hold on to.
    Flat {
        /// As in `Found`, below the limit.
        min_eigenvalue: f32,
    },
    /// The point is, or went, outside the image or too close to its border; also where a coordinate is no number.
    LeftImage,
    /// What was found does not look the same, or the search did not come to rest within reach.
    Different {
        /// Correlation of the two windows.
        correlation: f32,
    },
    /// The way back ends elsewhere.
    Inconsistent {
        /// Distance from the start, px; infinite when the way back was not found at all.
        backward_px: f32,
    },
}

impl LkVerdict {
    /// Whether the point was found.
    pub fn is_found(&self) -> bool {
        matches!(self, Self::Found { .. })
    }
}

/// One point on its way from the source image to the target image, px of the full images.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Flow {
    /// Where the point is in the source image.
    pub source_px: [f32; 2],
    /// In: where it is expected in the target image. Out: where it was found; unchanged unless found.
    pub target_px: [f32; 2],
    /// What became of it.
    pub verdict: LkVerdict,
}

impl Flow {
    /// A point that is expected at `expected_px`.
    pub const fn new(source_px: [f32; 2], expected_px: [f32; 2]) -> Self {
        Self { source_px, target_px: expected_px, verdict: LkVerdict::Pending }
    }
}

/// Searches every pending point of `flows` in `target`, starting at its `target_px`, coarse to fine.
///
/// Minimises  Σ_w (J(u + w) - g I(p + w) - b)²  over the position u, with contrast g and brightness b projected out;
/// w runs over the 21 x 21 px window, I is `source`, J is `target`.
///
/// # Output
/// `target_px` and `verdict` of every flow that was pending; the others are left alone.
///
/// # Cost
/// O(n * levels * steps); 7 KiB of stack; no allocation. Same bits on every SIMD level.
///
/// # Source
/// Bouguet 2001, "Pyramidal implementation of the affine Lucas Kanade feature tracker"; photometric projection:
/// Baker & Matthews 2004, part 3.
pub fn track(simd: SimdLevel, source: &Pyramid<'_>, target: &Pyramid<'_>, settings: &LkSettings, flows: &mut [Flow]) {
    simd.run(Search { source, target, settings, flows, there_and_back: false });
}

/// As [`track`], and then back from where each point was found: those that do not return are `Inconsistent`.
///
/// The way back starts at the reverse of the displacement that the way there was expected to have, so that it
/// does not know the answer.
pub fn track_there_and_back(
    simd: SimdLevel,
    source: &Pyramid<'_>,
    target: &Pyramid<'_>,
    settings: &LkSettings,
    flows: &mut [Flow],
) {
    simd.run(Search { source, target, settings, flows, there_and_back: true });
}

struct Search<'a, 'p> {
    source: &'a Pyramid<'p>,
    target: &'a Pyramid<'p>,
    settings: &'a LkSettings,
    flows: &'a mut [Flow],
    there_and_back: bool,
}

impl KernelTask for Search<'_, '_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Self { source, target, settings, flows, there_and_back } = self;
        let mut template = Template::NONE;
        for flow in flows.iter_mut() {
            if flow.verdict != LkVerdict::Pending {
                continue;
            }
            let expected = [flow.target_px[0] - flow.source_px[0], flow.target_px[1] - flow.source_px[1]];
            let (target_px, verdict) =
                search(kernel, &mut template, source, target, settings, flow.source_px, flow.target_px);
            flow.verdict = verdict;
            if !verdict.is_found() {
                continue;
            }
            if there_and_back {
                let expected_back = [target_px[0] - expected[0], target_px[1] - expected[1]];
                let (back_px, back) = search(kernel, &mut template, target, source, settings, target_px, expected_back);
                let backward_px = match back.is_found() {
                    true => kernel.sqrt(squared_distance(back_px, flow.source_px).into()) as f32,
                    false => f32::INFINITY,
                };
                if backward_px > settings.max_backward_px {
                    flow.verdict = LkVerdict::Inconsistent { backward_px };
                    continue;
                }
            }
            flow.target_px = target_px;
        }
    }
}

/// Squared distance of two pixels, px².
#[inline(always)]
pub(crate) fn squared_distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    dx * dx + dy * dy
}

/// One point, coarse to fine.
#[inline(always)]
fn search<K: Kernel>(
    kernel: K,
    template: &mut Template,
    source: &Pyramid<'_>,
    target: &Pyramid<'_>,
    settings: &LkSettings,
    source_px: [f32; 2],
    expected_px: [f32; 2],
) -> ([f32; 2], LkVerdict) {
    let inside = |pyramid: &Pyramid<'_>, px| is_inside(pyramid, px, settings.border_px);
    if !inside(source, source_px) || !expected_px.iter().all(|c| c.is_finite()) {
        return (expected_px, LkVerdict::LeftImage);
    }
    let mut target_px = expected_px;
    let coarsest = (settings.n_levels as usize).min(source.n_levels()).min(target.n_levels());
    for l in (1..coarsest).rev() {
        let (Some(from), Some(to)) = (source.level(l), target.level(l)) else { continue };
        let scale = 1.0 / (1u32 << l) as f32;
        if from.width().min(from.height()) < WINDOW {
            continue;
        }
        if template.take_around(kernel, &from, source_px.map(|c| c * scale)).is_none() {
            continue;
        }
        if template.min_eigenvalue(kernel) < settings.min_eigenvalue {
            continue;
        }
        let start = target_px.map(|c| c * scale);
        let found = descend(kernel, template, &to, start, 1.0, settings.max_steps, settings.coarse_converged_px);
        target_px = found.map_or(target_px, |px| px.map(|c| c / scale));
    }
    let (Some(from), Some(to)) = (source.level(0), target.level(0)) else { return (target_px, LkVerdict::LeftImage) };
    if template.take_around(kernel, &from, source_px).is_none() {
        return (target_px, LkVerdict::LeftImage);
    }
    let min_eigenvalue = template.min_eigenvalue(kernel);
    if min_eigenvalue < settings.min_eigenvalue {
        return (target_px, LkVerdict::Flat { min_eigenvalue });
    }
    let found = descend(kernel, template, &to, target_px, 1.0, settings.max_steps, settings.converged_px);
    let px = found.unwrap_or(target_px);
    if !inside(target, px) {
        return (px, LkVerdict::LeftImage);
    }
    let correlation = template.correlation(kernel, &to, px).unwrap_or(-1.0);
    if found.is_none() || correlation < settings.min_correlation {
        return (px, LkVerdict::Different { correlation });
    }
    (px, LkVerdict::Found { correlation, min_eigenvalue })
}

/// Newton steps from `start_px` until they are shorter than `converged_px` or used up; `None` when the search
/// leaves the image or goes farther than the window reaches. Steps are `step_scale` times Newton's.
#[inline(always)]
pub(crate) fn descend<K: Kernel>(
    kernel: K,
    template: &Template,
    level: &PaddedImage<'_>,
    start_px: [f32; 2],
    step_scale: f32,
    max_steps: u32,
    converged_px: f32,
) -> Option<[f32; 2]> {
    const FARTHEST_PX: f32 = (WINDOW / 2) as f32;
    let mut px = start_px;
    let mut last_step = [0.0f32; 2];
    for _ in 0..max_steps {
        let step = template.compare(kernel, level, px)?.step_px?.map(|c| c * step_scale);
        px = [px[0] + step[0], px[1] + step[1]];
        if squared_distance(px, start_px) > FARTHEST_PX * FARTHEST_PX {
            return None;
        }
        if squared_distance(step, [0.0; 2]) < converged_px * converged_px {
            break;
        }
        // Bouguet's steps can swing between two places: the middle is the best guess.
        if squared_distance(step, last_step.map(|c| -c)) < converged_px * converged_px {
            px = [px[0] - 0.5 * step[0], px[1] - 0.5 * step[1]];
            break;
        }
        last_step = step;
    }
    Some(px)
}

/// Whether a pixel lies at least `border_px` inside the image; not a number is outside.
pub(crate) fn is_inside(pyramid: &Pyramid<'_>, px: [f32; 2], border_px: f32) -> bool {
    let within = |c: f32, size: usize| c >= border_px && c <= size as f32 - border_px;
    within(px[0], pyramid.width()) && within(px[1], pyramid.height())
}

#[cfg(test)]
mod tests;
