//! Moves the nodes to where their windows fit best, one level at a time.

use super::DenseSettings;
use super::field::DenseNode;
use crate::correspondence::ImagePair;
use crate::correspondence::window_search::{Expected, search};
use crate::features::SimdLevel;
use crate::features::lanes::{Kernel, KernelTask};
use crate::features::lk::is_inside;
use crate::frame::pyramid::PaddedImage;

/// How close to the border of the image a match may lie, px: half a window of the tracker.
const BORDER_PX: f32 = 11.0;

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

impl KernelTask for Refine<'_> {
    #[inline(always)]
    fn run<K: Kernel>(self, kernel: K) {
        let Self { pair, keyframe, current, level, settings, nodes } = self;
        for node in nodes.iter_mut().filter(|node| node.is_alive) {
            let DenseNode { keyframe_px, current_px, shape, .. } = *node;
            let expected = Expected { keyframe_px, current_px, shape };
            let found = search(kernel, [&keyframe, &current], level, &settings.windows, &expected)
                .filter(|found| is_inside(pair.current, found.current_px, BORDER_PX))
                .filter(|_| is_inside(pair.keyframe, node.keyframe_px, BORDER_PX));
            match found {
                Some(found) if level > 0 || node.sigma_px == f32::INFINITY => {
                    (node.current_px, node.correlation, node.sigma_px) =
                        (found.current_px, found.correlation, found.sigma_px);
                    node.is_alive = found.correlation >= settings.windows.min_correlation;
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
